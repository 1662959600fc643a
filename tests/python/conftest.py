"""Shared fixtures: one device, one model, a few photos."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zipsplat

PHOTOS = Path(os.environ["ZIPSPLAT_PHOTOS"])
SIZE = (70, 70)


@pytest.fixture(scope="session")
def model() -> zipsplat.Model:
    return zipsplat.Model.load()


@pytest.fixture(scope="session")
def photos() -> list[Path]:
    return zipsplat.list_images(PHOTOS)[:3]


@pytest.fixture(scope="session")
def scene(model: zipsplat.Model, photos: list[Path]) -> zipsplat.Scene:
    return model.reconstruct(photos, input_size=SIZE)


@pytest.fixture()
def capture(tmp_path: Path) -> Path:
    """Creates a folder with three small photos of a random scene and their cameras."""
    rng = np.random.default_rng(3)
    means = rng.normal(size=(60, 3)) * 0.5 + [0, 0, 4]
    colors = rng.normal(size=(60, 1, 3))
    place = zipsplat.Scene.from_arrays(means, np.full((60, 3), 0.2), rng.normal(size=(60, 4)), np.full(60, 0.9), colors)
    cameras = []
    for i in range(3):
        pose = np.eye(4)
        pose[0, 3] = 0.3 * i
        cameras.append(zipsplat.Camera.from_fov(80, 60, 60, camera_to_world=pose))
    frames = []
    drawn = place.render(cameras)
    for i, (camera, picture) in enumerate(zip(cameras, drawn.rgb)):
        zipsplat.save_image(tmp_path / f"{i}.png", picture)
        matrix = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{i}.png", "transform_matrix": matrix.tolist()})
    lens = {"w": 80, "h": 60, "fl_x": cameras[0].fx, "fl_y": cameras[0].fy, "cx": 40, "cy": 30}
    import json

    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    place.save(tmp_path / "place.ply")
    return tmp_path


def python(code: str, *arguments: object, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Runs code in a separate interpreter."""
    program = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(program, capture_output=True, text=True, timeout=timeout, check=False)


def same(a: zipsplat.Scene, b: zipsplat.Scene) -> bool:
    """Returns whether two scenes are bitwise equal."""
    fields = ("means", "scales", "quats", "opacities", "sh_coeffs")
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in fields)
