"""Photos in the layouts of RealEstate10K and DL3DV become training records with consistent
cameras, images and depth.

python tests/train/captures.py ZIPSPLAT [FOLDER]    FOLDER: keeps the two data sets there
"""

import contextlib
import io
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools" / "train"))

import numpy as np
import torch
from safetensors.numpy import save_file

from captures import Captures, farthest
from data import Pool, Shards, generator_command, record, unproject

VIEWS, SIZE = 4, 56


def make(zipsplat, folder):
    """Writes two scenes in both layouts: 90 x 60 photos; DL3DV's camera has four times the
    resolution."""
    for seed in (3, 5):
        place = folder / f"place{seed}"
        command = [zipsplat, "scene", "--seed", str(seed), "--views", "8", "--size", "90x60", "-q", "-o", place]
        subprocess.run(command, check=True)
        cameras = json.loads((place / "transforms.json").read_text())

        scene = folder / "dl3dv" / f"scene{seed}" / "nerfstudio"
        shutil.copytree(place / "images", scene / "images_4")
        shutil.copytree(place / "depth", scene / "depth")
        for name in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            for fields in (cameras, *cameras["frames"]):
                if name in fields:
                    fields[name] *= 4
        (scene / "transforms.json").write_text(json.dumps(cameras))

        video = folder / "re10k" / f"scene{seed}"
        (video / "depth").mkdir(parents=True)
        lines = ["https://www.youtube.com/watch?v=0"]
        for i, frame in enumerate(cameras["frames"]):
            fields, stem = {**cameras, **frame}, Path(frame["file_path"]).stem
            shutil.copy(place / "images" / f"{stem}.png", video / f"{1000 * i}.png")
            shutil.copy(place / "depth" / f"{stem}.npy", video / "depth" / f"{1000 * i}.npy")
            lens = [fields["fl_x"] / fields["w"], fields["fl_y"] / fields["h"], fields["cx"] / fields["w"], fields["cy"] / fields["h"]]
            towards = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag((1.0, -1, -1, 1)))[:3]
            lines.append(" ".join(map(str, [1000 * i, *lens, 0, 0, *towards.flatten()])))
        video.with_suffix(".txt").write_text("\n".join(lines) + "\n")


def records(sources, count, **options):
    options = {"gap": [6, 8], "seed": 1, "count": count, **options}
    rows = np.zeros(count, record(VIEWS, SIZE, SIZE))
    stream = Captures(sources, rows.dtype, **options)
    assert stream.read_into(rows.view(np.uint8)) == count
    assert stream.read_into(rows.view(np.uint8)) == 0, "more scenes than were asked for"
    stream.close()
    return rows


def check_geometry(row):
    """Checks that points of a view reproject into another with the same color and depth."""
    depth, poses = torch.from_numpy(row["depths"].astype(np.float32)), torch.eye(4).repeat(VIEWS, 1, 1)
    poses[:, :3] = torch.from_numpy(row["poses"].copy())
    lens, colors = torch.from_numpy(row["intrinsics"].copy()), torch.from_numpy(row["colors"].copy()).float()
    pixels = torch.arange(VIEWS * SIZE * SIZE)
    points = unproject(depth[None], lens[None], poses[None], pixels[None])[0]
    errors, same = [], []
    for view in range(VIEWS):
        x, y, z = (torch.linalg.inv(poses[view]) @ torch.cat((points, torch.ones(len(points), 1)), 1).T)[:3]
        fx, fy, cx, cy = lens[view]
        u, v = fx * x / z + cx, fy * y / z + cy
        seen = (pixels // SIZE**2 != view) & (z > 0.05) & (u > 0) & (u < SIZE) & (v > 0) & (v < SIZE)
        at = depth[view][v[seen].long(), u[seen].long()]
        errors.append(((at - z[seen]).abs() / z[seen])[at > 0])
        there = colors[view][v[seen].long(), u[seen].long()]
        same.append((there - colors.flatten(0, 2)[seen]).abs().mean(1)[at > 0][errors[-1] < 0.02])
    errors, same = torch.cat(errors), torch.cat(same)
    assert len(errors) > 500, f"found {len(errors)} points that two views see"
    assert errors.median() < 0.005 and same.median() < 12, f"off by {errors.median():.3f} of the depth, {same.median():.0f} levels"
    positive = depth[depth > 0]
    assert abs(positive.median() - 1) < 0.01, f"found a median depth of {positive.median()}, expected 1"


def check_left_out(zipsplat, folder):
    """Checks that unusable scenes are named with the reason and skipped."""
    broken = folder / "broken"
    for reason, spoil in {
        "expected 19": lambda s: s.with_suffix(".txt").write_text(s.with_suffix(".txt").read_text() + "1 2 3\n"),
        "frames with photos": lambda s: [path.unlink() for path in list(s.glob("*.png"))[:5]],
        "No such file": lambda s: [path.unlink() for path in (s / "depth").glob("*.npy")],
        "expected the shape of its photo": lambda s: [np.save(path, np.ones((9, 9), "f4")) for path in (s / "depth").glob("*.npy")],
        "no depth above 0": lambda s: [np.save(path, np.zeros((60, 90), "f4")) for path in (s / "depth").glob("*.npy")],
    }.items():
        shutil.rmtree(broken, ignore_errors=True)
        shutil.copytree(folder / "re10k", broken)
        shutil.copytree(broken / "scene3", broken / "scene4")
        shutil.copy(broken / "scene3.txt", broken / "scene4.txt")
        spoil(broken / "scene4")
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            records([("re10k", broken, None)], 8)
        assert "left out scene4" in said.getvalue() and reason in said.getvalue(), (reason, said.getvalue())
    shutil.rmtree(broken / "scene3" / "depth")
    with contextlib.redirect_stderr(io.StringIO()):
        check_raised(Captures([("re10k", broken, None)], record(VIEWS, SIZE, SIZE), [6, 8], 1), "no scene that can be read")
    check_raised(Shards(generator_command(Path(zipsplat), SIZE, VIEWS, 1, scenes=4)), "the stream of scenes ended")


def check_raised(stream, words):
    """Checks that a stream's error reaches the waiting pool."""
    try:
        Pool(stream, 8, "cpu").fill(8)
        raise AssertionError("found scenes of a stream without them")
    except RuntimeError as error:
        assert words in str(error), error


def main(zipsplat, folder):
    make(zipsplat, folder)
    kinds = [(kind, folder / kind, None) for kind in ("re10k", "dl3dv")]
    theirs, ours = (records([source], 3) for source in kinds)
    for a, b in zip(theirs, ours):
        check_geometry(a)
        assert (a["colors"] == b["colors"]).all() and (a["depths"] == b["depths"]).all()
        assert np.abs(a["poses"] - b["poses"]).max() < 1e-4 and np.abs(a["intrinsics"] - b["intrinsics"]).max() < 1e-3
    again, other = records(kinds[:1], 3), records(kinds[:1], 3, seed=2)
    assert again.tobytes() == theirs.tobytes() and other.tobytes() != theirs.tobytes()
    unseen = records(kinds[:1], 3, unseen=True)
    assert all((picture != theirs["colors"]).any() for picture in unseen["colors"].reshape(-1, *theirs["colors"].shape[2:])[:VIEWS])
    mixed = records(kinds, 4)
    assert (mixed["colors"][0] == theirs["colors"][0]).all(), "the first is of the first folder"

    depths = folder / "depths"
    for kind in ("re10k", "dl3dv"):
        for depth in (folder / kind).glob("**/depth"):
            scene = depth.parent.parent.name if depth.parent.name == "nerfstudio" else depth.parent.name
            shutil.copytree(depth, depths / scene, dirs_exist_ok=True)
    moved = [(kind, path, depths) for kind, path, _ in kinds]
    assert records(moved, 4).tobytes() == mixed.tobytes()
    for scene in depths.iterdir():
        files = sorted(scene.glob("*.npy"))
        names = json.dumps([path.stem for path in files])
        save_file({"depth": np.stack([np.load(path) for path in files])}, scene / "depths.safetensors", {"zipsplat.photos": names})
        [path.unlink() for path in files]
    assert records(moved, 4).tobytes() == mixed.tobytes()

    assert farthest(np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [3, 0, 0]]), 0, 3) == [0, 2, 3]
    check_left_out(zipsplat, folder)
    fisheye = json.loads((folder / "dl3dv/scene3/nerfstudio/transforms.json").read_text()) | {"camera_model": "OPENCV_FISHEYE"}
    shutil.copytree(folder / "dl3dv", folder / "fisheye")
    for scene in (folder / "fisheye").glob("*/nerfstudio"):
        (scene / "transforms.json").write_text(json.dumps(fisheye))
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            records([("dl3dv", folder / "fisheye", None)], 1)
        raise AssertionError("found no error of a fisheye lens")
    except RuntimeError as error:
        assert "fisheye lens" in str(error), error
    print("captures: passed")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        main(sys.argv[1], Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as name:
            main(sys.argv[1], Path(name))
