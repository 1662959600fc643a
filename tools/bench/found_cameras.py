"""How good found cameras are: found_cameras.py [--refine] [--python PYTHON] CAPTURE...

For each folder with transforms.json and images it finds the cameras of the photos alone (`zipsplat cameras`), compares them with the given
ones after a similarity brings both together, and with --refine refines with either (`zipsplat eval --views 8 --refine 100`). Prints
a row of Markdown each: capture, found, rotation, position, focal length, points, PSNR of held-out photos with given and with found
cameras, time. PYTHON has pycolmap; ZIPSPLAT in the environment is the command.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from command import zipsplat


def cameras(path):
    """The poses of a transforms.json by the names of the photos, and their focal lengths."""
    text = json.loads(path.read_text())
    frames = {Path(frame["file_path"]).name: frame for frame in text["frames"]}
    poses = {name: np.array(frame["transform_matrix"]) for name, frame in frames.items()}
    return poses, {name: frame.get("fl_x", text.get("fl_x")) for name, frame in frames.items()}


def aligned(found, given):
    """The scale, rotation and shift that bring points to others in the sense of least squares (Umeyama 1991)."""
    (a, b), (ma, mb) = (found, given), (found.mean(0), given.mean(0))
    u, sizes, vt = np.linalg.svd((b - mb).T @ (a - ma))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (sizes * np.diag(sign)).sum() / ((a - ma) ** 2).sum()
    rotation = u @ sign @ vt
    return scale, rotation, mb - scale * rotation @ ma


def errors(found, given):
    """Median turn in degrees, and median distance as a share of the extent of the given cameras."""
    a, b = (np.array([poses[name] for name in sorted(found)]) for poses in (found, given))
    scale, rotation, shift = aligned(a[:, :3, 3], b[:, :3, 3])
    away = np.linalg.norm(scale * a[:, :3, 3] @ rotation.T + shift - b[:, :3, 3], axis=1)
    extent = np.linalg.norm(np.ptp(np.array([pose[:3, 3] for pose in given.values()]), axis=0))
    cosines = (np.trace(np.swapaxes(rotation @ a[:, :3, :3], 1, 2) @ b[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.median(np.arccos(cosines.clip(-1, 1)))), np.median(away) / extent


def row(capture, folder, options):
    """The figures of a capture, as cells."""
    photos = folder / "images"
    photos.symlink_to((capture / "images").resolve())
    out = folder / "found.json"
    begin = time.time()
    finder = ["--python", options.python] if options.python else []
    found = zipsplat("cameras", photos, "-o", out, *finder)
    seconds = time.time() - begin
    (poses, focals), (given, given_focals) = cameras(out), cameras(capture / "transforms.json")
    common = {name: poses[name] for name in poses if name in given}
    turn, away = errors(common, given)
    focal = np.median([focals[name] / given_focals[name] for name in common]) - 1
    psnr = []
    for source in [[capture], [photos, "--poses", out]] if options.refine else []:
        scored = zipsplat("eval", *source, "--views", 8, "--refine", 100, "--lpips", "none")
        psnr.append(f"{scored['mean']['psnr']:.2f} ({len(scored['views'])})")
    counts = f"{found['found']} of {found['photos']}" + (f", {found['mappings']} tries" if found["mappings"] > 1 else "")
    return [capture.name, counts, f"{turn:.2f}", f"{100 * away:.2f} %", f"{100 * focal:+.1f} %", f"{found['points']:,}", *psnr,
            f"{seconds:.0f} s"]


parser = argparse.ArgumentParser()
parser.add_argument("captures", nargs="+", type=Path)
parser.add_argument("--refine", action="store_true")
parser.add_argument("--python")
options = parser.parse_args()
for capture in options.captures:
    with tempfile.TemporaryDirectory() as folder:
        try:
            cells = row(capture, Path(folder), options)
        except RuntimeError as error:
            cells = [capture.name, str(error)]
    print("|", " | ".join(cells), "|", flush=True)
