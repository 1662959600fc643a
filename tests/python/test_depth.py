"""Depth and cameras of photos from random weights."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import zipsplat

SIDE = 70


@pytest.fixture(scope="module")
def depth_model() -> zipsplat.DepthModel:
    return zipsplat.DepthModel.load("seeded:da3-small", precision="fp32")


def test_depth_cameras_and_scene_of_photos(depth_model: zipsplat.DepthModel, photos: list[Path]) -> None:
    assert depth_model.is_multi_view and depth_model.patch_size == 14 and depth_model.precision == "fp32"
    stages: list[str] = []
    found = depth_model.predict(
        photos[:2], input_size=SIDE, progress=lambda now: bool(stages.append(now.stage)) or True
    )
    count, height, width = found.depth.shape
    assert (count, width, height % 14) == (2, SIDE, 0) and found.sky is None
    assert found.confidence is not None and found.confidence.shape == found.depth.shape
    assert (found.depth > 0).all() and (found.confidence >= 1).all() and "heads" in "".join(stages)
    size = zipsplat.load_image(photos[0]).shape
    first, second = found.image_cameras
    assert first is not None and second is not None
    # Photos share a focal length.
    assert (first.height, first.width) == size[:2] and first.fx == first.fy == second.fx
    assert math.isclose(float(np.linalg.det(first.camera_to_world[:3, :3])), 1, abs_tol=1e-6)
    # Cameras of the maps unproject them.
    alone = depth_model.predict(photos[:1], input_size=SIDE)
    [camera] = alone.cameras
    assert camera is not None and (camera.height, camera.width) == alone.depth.shape[1:]
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(camera.K).T
    points = (rays * alone.depth[0][..., None]).reshape(-1, 3) @ camera.camera_to_world[:3, :3].T
    means = alone.to_scene().means - camera.camera_to_world[:3, 3]
    error = np.linalg.norm(means[:, None] - points, axis=-1).min(1) / np.linalg.norm(means, axis=-1)
    assert len(means) > 100 and error.max() < 1e-4
    scene = found.to_scene(max_gaussians_per_patch=2)
    assert 0 < len(scene.means) <= 2 * count * height * width // 196
    kept = depth_model.predict(photos[:1], input_size=SIDE, keep_features=True)
    assert found.patch_tokens is None and kept.patch_tokens is not None
    assert kept.patch_tokens.shape == (1, camera.height // 14, camera.width // 14, kept.patch_tokens.shape[3])
    scene = kept.to_scene(max_gaussians_per_patch=2)
    features, _ = scene.lift(list(kept.patch_tokens), [camera])
    assert features.shape == (len(scene.means), kept.patch_tokens.shape[3]) and np.abs(features).max() > 0
    # Arrays outlive their object.
    known = [
        zipsplat.Camera.from_fov(size[1], size[0], 60, camera_to_world=np.eye(4) + np.eye(4, k=3) * shift)
        for shift in (0, 1)
    ]
    depth = depth_model.predict(photos[:2], known, input_size=SIDE).depth
    assert depth.shape == found.depth.shape and not np.array_equal(depth, found.depth)


def test_invalid_arguments_raise(depth_model: zipsplat.DepthModel, photos: list[Path]) -> None:
    with pytest.raises(zipsplat.ArgumentError, match="da3-small"):
        zipsplat.DepthModel.load("seeded:vits")
    with pytest.raises(ValueError, match="decoder"):
        depth_model.predict(photos[:1], camera_source="stars")
    with pytest.raises(zipsplat.ArgumentError, match="longest side"):
        depth_model.predict(photos[:1], input_size=13)
    with pytest.raises(zipsplat.CancelledError):
        depth_model.predict(photos[:1], input_size=SIDE, progress=lambda now: False)
