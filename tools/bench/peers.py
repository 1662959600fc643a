#!/usr/bin/env python3
"""Compares refinement with OpenSplat: same photos, cameras, initial points and CPU time.

usage: peers.py CAPTURE... [--seconds 60,240] [--opensplat PROGRAM] [--out FOLDER] [options below]

A capture has transforms.json without lens distortion, and a binary PLY of points. For each capture
and time, `zipsplat eval --init points --refine TIME` refines; OpenSplat gets the CPU time of that
command. `zipsplat eval` scores both on the same held-out photos. Prints a Markdown table; FOLDER
has table.md, the runs, and CAPTURE.png: a held-out photo, ours, OpenSplat at the longest time.
Finished runs are read from FOLDER. Needs Pillow and a built zipsplat, or $ZIPSPLAT.

OpenSplat ignores principal points: its crops have eval's scale but are centered on them, without
the few rows or columns that the photo lacks. Sides are multiples of 4, since training starts at a
quarter of the size. It runs on one thread. Runs are repeated with other numbers of steps until one
ends with at least 0.85 of the CPU time; of killed ones, the last saved scene counts. Build it with
zeros as backgroundColor in model.hpp, zipsplat's background, and with contiguous camDepths in
gsplat_cpu.cpp: it misreads PyTorch 2.15's strided ones.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from command import digest, timed, zipsplat
from PIL import Image

SHOWN = 12  # largest number of held-out photos in eval's comparison.png
PILOT_STEPS = 200
TRIES = 5
TYPES = {"uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
POINT = {"x": "float", "y": "float", "z": "float", "red": "uchar", "green": "uchar", "blue": "uchar"}


def arguments():
    parser = argparse.ArgumentParser(usage=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--seconds", default="60,240", help="times of refinement")
    parser.add_argument("--opensplat", default="opensplat", help="program")
    parser.add_argument("--opensplat-options", default="", help="more options of OpenSplat")
    parser.add_argument("--resolution-part", type=float, help="part of OpenSplat's steps at each smaller photo size")
    parser.add_argument("--views", type=int, help="training photos [default: 16; 10 of fewer than 20]")
    parser.add_argument("--size", type=int, default=252, help="side of the crops in pixels")
    parser.add_argument("--options", default="", help="more options of eval")
    parser.add_argument("--out", type=Path, default=Path("peers"), help="folder for the results")
    args = parser.parse_args()
    if not shutil.which(args.opensplat):
        sys.exit(f"found no program {args.opensplat}: put opensplat on PATH, or pass --opensplat PATH")
    args.seconds = sorted(int(seconds) for seconds in args.seconds.split(","))
    return args


def finished(folder, run):
    """Returns a run's result. The folder appears once the run is complete."""
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
            place = Path(temporary) / folder.name
            place.mkdir()
            (place / "eval.json").write_text(json.dumps(run(place)))
            place.rename(folder)
    return json.loads((folder / "eval.json").read_text())


def evaluate(args, capture, folder, *words):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    views = args.views or (16 if len(frames) >= 20 else 10)
    shape = ["--views", views, "--eval-size", f"{args.size}x{args.size}", "--lpips", "none"]
    said, _, cpu = timed(zipsplat, "eval", capture, *shape, *words, *shlex.split(args.options), "-o", folder)
    return said, cpu


def refine(args, capture, seconds, folder):
    said, cpu = evaluate(args, capture, folder, "--init", "points", "--refine", f"{seconds}s")
    return said | {"cpu": cpu, "steps": said["refined"]["steps"]}


def copy_points(source, target):
    """Copies positions and colors: OpenSplat misreads clouds with other properties."""
    with open(source, "rb") as file:
        lines = []
        while (line := file.readline().decode().split()) != ["end_header"]:
            lines.append(line)
        if ["format", "binary_little_endian", "1.0"] not in lines:
            sys.exit(f"{source}: not a binary little-endian PLY")
        columns = {line[2]: TYPES[line[1]] for line in lines if line[0] == "property"}
        row = struct.Struct("<" + "".join(columns.values()))
        count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
        places = [list(columns).index(name) for name in POINT]
        rows = [[values[i] for i in places] for values in row.iter_unpack(file.read(count * row.size))]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in POINT.items()] + ["end_header", ""]
    target.write_bytes("\n".join(lines).encode() + b"".join(struct.pack("<3f3B", *values) for values in rows))


def export(args, capture, names, folder):
    """Writes the named photos, cropped around principal points, with cameras and points."""
    text = json.loads((capture / "transforms.json").read_text())
    frames = []
    for frame in (frame for frame in text["frames"] if frame["file_path"] in names):
        lens = {key: frame.get(key, text.get(key, 0)) for key in "w h fl_x fl_y cx cy k1 k2 k3 p1 p2".split()}
        if any(lens[key] for key in ("k1", "k2", "k3", "p1", "p2")):
            sys.exit(f"{capture}: photos with lens distortion")
        photo = Image.open(capture / frame["file_path"]).convert("RGB")
        scale = args.size / min(photo.size)
        resized = [side / lens[key] for side, key in zip(photo.size, "wh")]
        center = [lens[key] * by for key, by in zip(("cx", "cy"), resized)]
        most = [min(args.size, 2 * scale * min(at, side - at)) for at, side in zip(center, photo.size)]
        size = [int(side) // 4 * 4 for side in most]
        box = [at + sign * side / scale / 2 for sign in (-1, 1) for at, side in zip(center, size)]
        name = f"{len(frames):04}.png"
        photo.resize(size, Image.Resampling.LANCZOS, box).save(folder / name)
        camera = {"w": size[0], "h": size[1], "cx": size[0] / 2, "cy": size[1] / 2}
        camera |= {key: lens[key] * by * scale for key, by in zip(("fl_x", "fl_y"), resized)}
        frames.append(camera | {"file_path": name, "transform_matrix": frame["transform_matrix"]})
    assert len(frames) == len(names), f"{len(frames)} of {len(names)} photos in transforms.json"
    copy_points(capture / text.get("ply_file_path", "points.ply"), folder / "points.ply")
    told = {"camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(told))


def train(args, data, steps, limit):
    """Trains within CPU seconds. Returns the last saved scene, its step, all steps, CPU seconds."""
    words = [args.opensplat, data, "-o", data / "splat.ply", "--keep-crs", "--cpu", f"-n{steps}", f"-s{max(1, steps // 10)}"]
    if args.resolution_part:
        words += ["--resolution-schedule", max(1, round(args.resolution_part * steps))]
    words = map(str, [*words, *shlex.split(args.opensplat_options)])
    cpu = 0
    with open(data / "log", "w") as log:
        run = subprocess.Popen(words, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})
    while run.poll() is None:
        # RLIMIT_CPU counts ticks, which differ from the measured time by 10 % on a busy machine.
        times = Path(f"/proc/{run.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
        cpu = sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
        if cpu >= limit:
            run.kill()
        time.sleep(0.1)
    said = (data / "log").read_text()
    if run.returncode not in (0, -signal.SIGKILL):
        sys.exit(f"{args.opensplat}: {(said.strip().splitlines() or [run.returncode])[-1]}")
    reached = max(map(int, re.findall(r"^Step (\d+):", said, re.M)), default=1)
    scene = (re.findall(r"^Wrote (.+\.ply)$", said, re.M) or [None])[-1]
    saved = int(re.search(rb"at iteration (\d+)", Path(scene).read_bytes()[:200])[1]) if scene else 0
    return scene, saved, reached, cpu


def steps_within(args, limit, steps, cpu):
    """Extrapolates from a run's steps and CPU seconds. Growing photos slow down later steps."""
    factor, exponent = (0.99, 1.0) if args.resolution_part else (0.95, 0.8)
    return max(20, round(factor * steps * (limit / cpu) ** exponent))


def opensplat(args, capture, ours, shorter, folder):
    limit = round(ours["cpu"])
    steps = steps_within(args, limit, shorter["steps"], shorter["cpu"]) if shorter else PILOT_STEPS
    with tempfile.TemporaryDirectory() as data:
        export(args, capture, ours["inputs"], Path(data))
        for _ in range(TRIES):
            scene, saved, reached, cpu = train(args, Path(data), steps, limit)
            print(f"{capture.name}: {reached} of {steps} steps in {cpu:.0f} of {limit} CPU seconds", file=sys.stderr)
            if saved == steps and cpu >= 0.85 * limit:
                break
            steps = steps_within(args, limit, reached, cpu)
        if not scene:
            sys.exit(f"{args.opensplat} saved no scene in {limit} CPU seconds")
        said, _ = evaluate(args, capture, folder, "--scene", scene, "--scene-frame", "input-cameras", "--drop-invalid")
    return said | {"cpu": cpu, "steps": saved}


def save_strip(path, size, views, folders):
    """Shows the held-out photo with the median PSNR of ours, and both renders."""
    shown = min(SHOWN, len(views))
    middle = sorted(range(shown), key=lambda i: views[i * len(views) // shown]["psnr"])[shown // 2]
    left, top = middle % 2 * 3 * size, middle // 2 * size
    sheets = [Image.open(folder / "comparison.png").convert("RGB") for folder in folders]
    strip = Image.new("RGB", (3 * size, size))
    for i, (sheet, column) in enumerate(((sheets[0], 0), (sheets[0], 1), (sheets[1], 1))):
        x = left + column * size
        strip.paste(sheet.crop((x, top, x + size, top + size)), (i * size, 0))
    strip.save(path)


def main():
    args = arguments()
    lines = ["| capture | time | system | CPU time | steps | Gaussians | PSNR | SSIM |", "|---|---|---|---|---|---|---|---|"]
    print("\n".join(lines), flush=True)
    shared = args.views, args.size, args.options
    systems = {
        "ours": digest(*shared),
        "opensplat": digest(*shared, args.opensplat_options, args.resolution_part),
    }
    for capture in args.captures:
        peer = None
        for seconds in args.seconds:
            folders = [args.out / f"{capture.name}.{seconds}.{system}.{settings}" for system, settings in systems.items()]
            ours = finished(folders[0], lambda place: refine(args, capture, seconds, place))  # noqa: B023
            peer = finished(folders[1], lambda place: opensplat(args, capture, ours, peer, place))  # noqa: B023
            for system, said in (("ours", ours), ("OpenSplat", peer)):
                mean, counts = said["mean"], f"{said['cpu']:.0f} s | {said['steps']:,} | {said['gaussians']:,}"
                lines.append(f"| {capture.name} | {seconds} s | {system} | {counts} | {mean['psnr']:.2f} dB | {mean['ssim']:.3f} |")
                print(lines[-1], flush=True)
        save_strip(args.out / f"{capture.name}.png", args.size, ours["views"], folders)
    (args.out / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
