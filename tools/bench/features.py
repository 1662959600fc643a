#!/usr/bin/env python3
"""Compares features held by tokens with features held by Gaussians: bytes and CPU time.

usage: features.py OUT [options]      needs NumPy

Lifts random values of one photo of 252 x 252 pixels to random scenes of 32 Gaussians per token, and
draws them. Prints bytes of the features, and CPU seconds of `zipsplat lift` and `zipsplat render`,
as Markdown. Features of more than --limit bytes are not lifted.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from command import timed, zipsplat

GROUP, SIDE, CELLS = 32, 252, 18
FRAME = {"file_path": "a.png", "transform_matrix": np.diag([1, -1, -1, 1]).tolist()}
CAMERA = {"fl_x": SIDE, "fl_y": SIDE, "cx": SIDE / 2, "cy": SIDE / 2, "w": SIDE, "h": SIDE, "frames": [FRAME]}
PROPERTIES = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()


def write_scene(path, count):
    """Writes Gaussians before the camera whose size shrinks with their number."""
    rng = np.random.default_rng(1)
    rows = rng.uniform(-1, 1, (count, len(PROPERTIES))).astype("<f4")
    rows[:, 2] += 4
    rows[:, 9] = 0
    rows[:, 10:13] -= np.log(count) / 3
    header = [f"element vertex {count}", *(f"property float {name}" for name in PROPERTIES), "end_header", ""]
    path.write_bytes("\n".join(["ply", "format binary_little_endian 1.0", *header]).encode() + rows.tobytes())


def measure(out, scene, group):
    """Returns the CPU seconds of lifting and drawing."""
    cameras, features = ["--cameras", out / "cameras.json"], out / "features.safetensors"
    grouped = ["--gaussians-per-token", group, "-o", features, "--overwrite"]
    _, _, lift = timed(zipsplat, "lift", scene, out / "values", *cameras, *grouped)
    _, _, draw = timed(zipsplat, "render", scene, *cameras, "--features", features, "-o", out / "pictures", "--overwrite")
    return lift, draw


def main():
    parser = argparse.ArgumentParser(usage=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--tokens", default="1122,7776,62500", help="numbers of tokens")
    parser.add_argument("--channels", default="64,384,768")
    parser.add_argument("--limit", type=float, default=1e9)
    args = parser.parse_args()
    (args.out / "values").mkdir(parents=True, exist_ok=True)
    (args.out / "cameras.json").write_text(json.dumps(CAMERA))
    print("| Gaussians | channels | tokens: MB | lift | draw | Gaussians: MB | lift | draw |")
    print("|---|---|---|---|---|---|---|---|")
    for tokens in map(int, args.tokens.split(",")):
        scene = args.out / "scene.ply"
        write_scene(scene, tokens * GROUP)
        for channels in map(int, args.channels.split(",")):
            values = np.random.default_rng(channels).normal(size=(CELLS, CELLS, channels)).astype("<f4")
            np.save(args.out / "values/a.npy", values)
            cells = []
            for group in (GROUP, 1):
                size = 4 * channels * tokens * GROUP // group
                times = [f"{seconds:.1f} s" for seconds in measure(args.out, scene, group)] if size < args.limit else ["", ""]
                cells += [f"{size / 1e6:,.1f}", *times]
            print(f"| {tokens * GROUP:,} | {channels} |", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
