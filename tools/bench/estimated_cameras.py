#!/usr/bin/env python3
"""Measures estimated cameras: estimated_cameras.py [--python PYTHON] CAPTURE...

For each folder with transforms.json and images, estimates cameras (`zipsplat cameras`) and aligns
them with the given ones by a similarity. Prints a Markdown row per capture: registered photos,
errors of rotation, position and focal length, points, seconds.
PYTHON has pycolmap; $ZIPSPLAT is the command.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from command import zipsplat


def cameras(path):
    """Returns poses and focal lengths of a transforms.json by photo name."""
    text = json.loads(path.read_text())
    frames = {Path(frame["file_path"]).name: frame for frame in text["frames"]}
    poses = {name: np.array(frame["transform_matrix"]) for name, frame in frames.items()}
    return poses, {name: frame.get("fl_x", text.get("fl_x")) for name, frame in frames.items()}


def aligned(found, given):
    """Least-squares similarity (scale, rotation, shift) from `found` to `given` (Umeyama 1991)."""
    (a, b), (ma, mb) = (found, given), (found.mean(0), given.mean(0))
    u, sizes, vt = np.linalg.svd((b - mb).T @ (a - ma))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (sizes * np.diag(sign)).sum() / ((a - ma) ** 2).sum()
    rotation = u @ sign @ vt
    return scale, rotation, mb - scale * rotation @ ma


def errors(found, given):
    """Median rotation error in degrees and position error relative to the cameras' extent."""
    a, b = (np.array([poses[name] for name in sorted(found)]) for poses in (found, given))
    scale, rotation, shift = aligned(a[:, :3, 3], b[:, :3, 3])
    away = np.linalg.norm(scale * a[:, :3, 3] @ rotation.T + shift - b[:, :3, 3], axis=1)
    extent = np.linalg.norm(np.ptp(np.array([pose[:3, 3] for pose in given.values()]), axis=0))
    cosines = (np.trace(np.swapaxes(rotation @ a[:, :3, :3], 1, 2) @ b[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.median(np.arccos(cosines.clip(-1, 1)))), np.median(away) / extent


def row(capture, folder, options):
    """Returns a capture's table cells."""
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
    counts = f"{found['registered']} of {found['photos']}" + (f", {found['attempts']} tries" if found['attempts'] > 1 else "")
    return [capture.name, counts, f"{turn:.2f}", f"{100 * away:.2f} %", f"{100 * focal:+.1f} %", f"{found['points']:,}",
            f"{seconds:.0f} s"]


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("captures", nargs="+", type=Path)
parser.add_argument("--python")
options = parser.parse_args()
for capture in options.captures:
    with tempfile.TemporaryDirectory() as folder:
        try:
            cells = row(capture, Path(folder), options)
        except RuntimeError as error:
            cells = [capture.name, str(error)]
    print("|", " | ".join(cells), "|", flush=True)
