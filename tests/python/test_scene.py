"""Scenes: zero-copy arrays, files, pictures, pages."""

from __future__ import annotations

import copy
import gc
import json
import os
import pickle
import stat
from pathlib import Path

import numpy as np
import pytest
import zipsplat
from conftest import same


def test_arrays_are_read_only_views_that_keep_the_scene_alive(scene: zipsplat.Scene) -> None:
    made = zipsplat.Scene.from_arrays(scene.means, scene.scales, scene.quats, scene.opacities, scene.sh_coeffs)
    assert same(made, scene) and len(made) == len(scene) > 0
    assert made.means.ctypes.data == zipsplat.Scene(made._scene).means.ctypes.data
    means, expected = made.means, scene.means.copy()
    with pytest.raises(ValueError):
        means[0, 0] = 1
    del made
    gc.collect()
    # More scenes would reuse freed memory.
    others = [
        zipsplat.Scene.from_arrays(scene.means + 1, scene.scales, scene.quats, scene.opacities, scene.sh_coeffs)
        for _ in range(3)
    ]
    assert np.array_equal(means, expected) and len(others) == 3


@pytest.mark.parametrize("format", ["ply", "spz", "splat", "gltf", "glb"])
def test_every_format_is_written_and_read(scene: zipsplat.Scene, tmp_path: Path, format: str) -> None:
    path = tmp_path / f"scene.{format}"
    scene.save(path)
    opened = zipsplat.Scene.open(path)
    assert len(opened) == len(scene)
    if format != "gltf":
        data = scene.to_bytes(format)
        assert data == path.read_bytes()
        assert same(zipsplat.Scene.from_bytes(data, format), opened)
    if format in ("ply", "gltf", "glb"):
        assert np.array_equal(opened.means, scene.means)
    if format == "spz":
        scene.save(path, spz_version=2)
        assert len(zipsplat.Scene.open(path)) == len(scene)
        with pytest.raises(zipsplat.ArgumentError, match="SPZ version"):
            scene.save(path, spz_version=9)


def test_scenes_are_copied_and_pickled_with_every_bit(scene: zipsplat.Scene) -> None:
    assert same(pickle.loads(pickle.dumps(scene)), scene)
    assert same(copy.deepcopy(scene), scene)


def test_antialiased_scenes_stay_so_and_are_rendered_as_such(scene: zipsplat.Scene, tmp_path: Path) -> None:
    fields = [scene.means, scene.scales * 0.02, scene.quats, scene.opacities, scene.sh_coeffs]
    plain, tagged = zipsplat.Scene.from_arrays(*fields), zipsplat.Scene.from_arrays(*fields, antialiased=True)
    assert not plain.antialiased and tagged.antialiased and "antialiased" in tagged._repr_html_()
    assert pickle.loads(pickle.dumps(tagged)).antialiased and tagged.edit([("scale", 2)], merge=[tagged]).antialiased
    for format in ("ply", "spz", "sog"):
        assert zipsplat.Scene.from_bytes(tagged.to_bytes(format), format).antialiased
    with pytest.raises(zipsplat.ArgumentError, match="antialiased"):
        plain.edit(merge=[tagged])
    camera = zipsplat.Camera.from_fov(40, 30)
    on, off = (plain.render(camera, antialiased=mode).rgb for mode in (True, False))
    assert (on != off).any()
    assert (tagged.render(camera).rgb == on).all() and (plain.render(camera).rgb == off).all()
    assert (tagged.render(camera, antialiased=False).rgb == off).all()


def test_edits_apply_in_order_and_count(scene: zipsplat.Scene) -> None:
    edited = scene.edit([("scale", 2), ("min_opacity", float(np.median(scene.opacities))), "sort"], merge=[scene])
    kept = scene.opacities >= np.float32(np.median(scene.opacities))
    assert edited.edit_counts == [2 * len(scene), 2 * kept.sum(), 2 * kept.sum()] and len(edited) == 2 * kept.sum()
    expected = np.concatenate([scene.means[kept] * 2] * 2)
    assert np.allclose(np.sort(edited.means, axis=0), np.sort(expected, axis=0))
    assert edited.edit_sources is not None and scene.edit_sources is None
    assert np.array_equal(edited.means, np.concatenate([scene.means] * 2)[edited.edit_sources] * 2)
    assert len(scene.edit([("decimate", 0.5)])) == round(len(scene) / 2)
    camera = zipsplat.Camera.from_fov(64, 48, 40)
    assert len(scene.edit([("min_views", 1)], cameras=[camera])) < len(scene)
    for edits, words in [
        (["vanish"], "vanish"),
        ([("crop_sphere", (0, 0, 1))], "crop-sphere"),
        ([("translate", range(7))], "7 numbers"),
        (["level"], "no cameras"),
    ]:
        with pytest.raises(zipsplat.ArgumentError, match=words):
            scene.edit(edits)


def test_features_are_lifted_and_rendered(scene: zipsplat.Scene) -> None:
    cameras = [zipsplat.Camera.from_fov(64, 48, 60)] * 2
    ramp = np.linspace(0, 1, 64 * 48 * 20, dtype=np.float32).reshape(48, 64, 20)
    constant = np.full((3, 4, 20), 2.5, np.float32)
    features, weights = scene.lift([constant, constant], cameras)
    assert features.shape == (len(scene), 20) and weights.shape == (len(scene),)
    assert np.allclose(features[weights > 0], 2.5, rtol=1e-5) and not features[weights == 0].any()
    one, half = scene.lift([ramp], cameras[:1]), scene.lift([ramp, ramp * np.nan], cameras)
    assert all(np.array_equal(a, b) for a, b in zip(one, half)), "NaN does not count"
    grouped, group_weights = scene.lift([ramp], cameras[:1], group=2)
    sums = (one[0] * one[1][:, None]).reshape(-1, 2, 20).sum(1)
    assert np.allclose(group_weights, one[1].reshape(-1, 2).sum(1), rtol=1e-5)
    assert np.allclose(grouped * group_weights[:, None], sums, rtol=1e-4, atol=1e-4)
    pictures = scene.render_features(grouped, cameras)
    assert pictures.shape == (2, 48, 64, 20) and np.array_equal(pictures[0], pictures[1])
    alpha = scene.render(cameras[0], alpha=True).alpha
    assert alpha is not None
    assert np.allclose(scene.render_features(np.ones((len(scene), 1)), cameras[:1])[0, ..., 0], alpha, atol=1e-5)
    for call, words in [
        (lambda: scene.lift([ramp], cameras), "2 cameras"),
        (lambda: scene.lift([ramp, ramp[..., :3]], cameras), "shapes"),
        (lambda: scene.lift([ramp], cameras[:1], group=7919), "7919"),
        (lambda: scene.render_features(np.ones((len(scene) - 1, 2)), cameras), "rows"),
    ]:
        with pytest.raises(zipsplat.ArgumentError, match=words):
            call()


def test_gsplat_and_torch_parameters_are_copies(scene: zipsplat.Scene) -> None:
    torch = pytest.importorskip("torch")
    params = scene.to_gsplat()
    assert sorted(params) == ["means", "opacities", "quats", "scales", "sh0", "shN"]
    assert params["sh0"].shape[1:] == (1, 3) and all(torch.isfinite(tensor).all() for tensor in params.values())
    back = zipsplat.Scene.from_gsplat(torch.nn.ParameterDict(params))
    for name, tensor in scene.to_torch().items():
        assert np.allclose(getattr(back, name), tensor, rtol=1e-5, atol=2e-7), name
        tensor.zero_()
    assert scene.means.any(), "tensors are copies"
    with pytest.raises(zipsplat.ArgumentError, match="shN"):
        zipsplat.Scene.from_gsplat({name: params[name] for name in params if name != "shN"})


def test_invalid_scenes_raise(scene: zipsplat.Scene, tmp_path: Path) -> None:
    fields = [scene.means, scene.scales, scene.quats, scene.opacities, scene.sh_coeffs]
    with pytest.raises(ValueError, match=r"quats: found shape \[\d+, 3\]"):
        zipsplat.Scene.from_arrays(fields[0], fields[1], fields[2][:, :3], fields[3], fields[4])
    with pytest.raises(zipsplat.ArgumentError, match="opacit"):
        zipsplat.Scene.from_arrays(*fields[:3], fields[3] + 2, fields[4])
    with pytest.raises(OSError):
        zipsplat.Scene.open(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(zipsplat.FormatError, match="bad.ply"):
        zipsplat.Scene.open(tmp_path / "bad.ply")
    data = bytearray(scene.to_bytes("ply"))
    data[-4:] = np.float32(np.nan).tobytes()
    with pytest.raises(zipsplat.Error):
        zipsplat.Scene.from_bytes(bytes(data))
    dropped = zipsplat.Scene.from_bytes(bytes(data), drop_invalid=True)
    assert (len(dropped), dropped.dropped_count) == (len(scene) - 1, 1)


def test_render_outputs_have_shapes_and_dtypes(scene: zipsplat.Scene) -> None:
    pose = np.eye(4)
    pose[0, 3] = 0.1
    cameras = [zipsplat.Camera.from_fov(48, 36), zipsplat.Camera.from_fov(48, 36, camera_to_world=pose)]
    renderer = zipsplat.Renderer(scene)
    both = renderer.render(cameras, alpha=True, depth="expected")
    assert (both.rgb.shape, both.rgb.dtype) == ((2, 36, 48, 3), np.uint8)
    assert both.alpha is not None and both.depth is not None
    assert both.alpha.shape == both.depth.shape == (2, 36, 48)
    assert both.rgb.max() > 0 and 0 < both.alpha.max() <= 1 and both.depth.max() > 0
    one = renderer.render(cameras[1])
    assert one.rgb.shape == (36, 48, 3) and one.alpha is None and np.array_equal(one.rgb, both.rgb[1])
    floats = renderer.render(cameras[1], dtype=np.float32).rgb
    assert np.array_equal((np.clip(floats, 0, 1) * 255).astype(np.uint8), one.rgb)
    lit = renderer.render(cameras[1], background=(1, 1, 1), dtype=np.float32).rgb
    assert np.allclose(lit - floats, 1 - both.alpha[1][..., None], atol=1e-5)
    normals = renderer.render(cameras, normals=True).normals
    assert normals is not None and normals.shape == (2, 36, 48, 3)
    assert np.allclose(np.linalg.norm(normals[both.alpha > 0.5], axis=-1), 1, atol=1e-4)
    accumulated = renderer.render(cameras, depth="accumulated").depth
    assert np.allclose(accumulated, both.depth * both.alpha, rtol=1e-4, atol=1e-4)
    empty = zipsplat.Scene.from_arrays(
        np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 1, 3))
    )
    renderer.set_scene(empty)
    assert renderer.render(cameras[0]).rgb.max() == 0 and len(empty) == 0


def test_renderers_take_arrays_and_scenes_points(scene: zipsplat.Scene, capture: Path) -> None:
    camera = zipsplat.Camera.from_fov(48, 36)
    with zipsplat.Renderer() as renderer:
        renderer.update_gaussians(**scene.to_numpy())
        assert np.array_equal(renderer.render(camera).rgb, scene.render(camera).rgb)
        thin = {**scene.to_numpy(), "scales": scene.scales * 0.02, "antialiased": True}
        renderer.update_gaussians(**thin)
        assert np.array_equal(renderer.render(camera).rgb, zipsplat.Scene.from_arrays(**thin).render(camera).rgb)
        assert (renderer.render(camera, antialiased=False).rgb != renderer.render(camera).rgb).any()
        unaligned = np.frombuffer(b" " + scene.means.tobytes(), np.float32, offset=1).reshape(-1, 3)
        renderer.update_gaussians(**{**scene.to_numpy(), "means": unaligned})
        assert np.array_equal(renderer.render(camera).rgb, scene.render(camera).rgb)
        renderer.update_gaussians(**{**scene.to_numpy(), "opacities": 0 * scene.opacities})
        assert renderer.render(camera).rgb.max() == 0
        with pytest.raises(zipsplat.ArgumentError, match="opacit"):
            renderer.update_gaussians(**{**scene.to_numpy(), "opacities": 2 + scene.opacities})
    points = np.random.default_rng(1).normal(size=(30, 3)) + [0, 0, 4]
    opened = zipsplat.Capture.open(capture)
    red = zipsplat.Scene.from_points(points, np.full((30, 3), [255, 0, 0]), opened.cameras)
    joined = zipsplat.Scene.from_points(points, images=opened)
    assert np.array_equal(joined.means[:30], points.astype(np.float32))
    with pytest.raises(zipsplat.ArgumentError, match="cameras"):
        zipsplat.Scene.from_points(points, images=[np.zeros((20, 30, 3), np.uint8)] * 3)
    assert np.array_equal(red.means, points.astype(np.float32)) and len(zipsplat.Scene.from_points(points)) == 30
    assert red.sh_coeffs[:, 0, 0].min() > 0 > red.sh_coeffs[:, 0, 1:].max()
    with pytest.raises(zipsplat.ArgumentError, match=r"colors: found shape \[29, 3\]"):
        zipsplat.Scene.from_points(points, np.zeros((29, 3), np.uint8))
    for colors in (np.full((30, 3), 0.5), np.full((30, 3), 256)):
        with pytest.raises(zipsplat.ArgumentTypeError, match="whole numbers from 0 to 255"):
            zipsplat.Scene.from_points(points, colors)


def test_invalid_render_arguments_raise(scene: zipsplat.Scene) -> None:
    camera, other = zipsplat.Camera.from_fov(48, 36), zipsplat.Camera.from_fov(40, 36)
    for cameras, options, words in [
        ([camera, other], {}, "all of one size"),
        ([], {}, "at least one"),
        (camera, {"dtype": np.int16}, "int16"),
        (camera, {"depth": "mean"}, "'accumulated'"),
        (camera, {"background": (0.5,)}, "background: found 1 values, expected 3"),
        (camera, {"background": (0.5,) * 4}, "background: found 4 values"),
        (zipsplat.Camera.from_fov(48, 36, camera_to_world=np.full((4, 4), np.nan)), {}, "camera 0"),
    ]:
        with pytest.raises(ValueError, match=words):
            scene.render(cameras, **options)


def test_matrix_names_state_their_direction() -> None:
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [1, 2, 3]
    K = np.array([[50, 0, 24], [0, 51, 18], [0, 0, 1]])
    [one] = zipsplat.Camera.from_matrices([K], 48, 36, camera_to_world=[pose])
    [other] = zipsplat.Camera.from_matrices(K, 48, 36, world_to_camera=np.linalg.inv(pose)[None])
    assert np.allclose(one.camera_to_world, other.camera_to_world) and np.array_equal(one.K, K)
    assert np.allclose(one.world_to_camera @ pose, np.eye(4))
    assert np.allclose(one.relative_to(other).camera_to_world, np.eye(4))
    both = zipsplat.Camera.from_matrices(K, 48, 36, camera_to_world=[pose[:3], pose[:3]])
    assert np.array_equal(both.camera_to_world, [pose, pose]) and np.array_equal(both.Ks, [K, K])
    assert (
        np.allclose(both.viewmats @ pose, np.eye(4)) and isinstance(both[1:], zipsplat.Cameras) and len(both[1:]) == 1
    )
    for options, words in [
        ({}, "one of them"),
        ({"camera_to_world": [pose], "world_to_camera": [pose]}, "one of them"),
        ({"camera_to_world": pose}, r"\[C, 4, 4\]"),
        ({"camera_to_world": [pose, pose], "Ks": [K]}, "Ks"),
    ]:
        with pytest.raises(ValueError, match=words):
            zipsplat.Camera.from_matrices(**{"Ks": K, "width": 48, "height": 36, **options})


def test_captures_are_sequences_of_photos(capture: Path) -> None:
    opened = zipsplat.Capture.open(capture / "transforms.json")
    assert len(opened) == 3 and [photo.name for photo in opened] == ["0.png", "1.png", "2.png"]
    assert opened[1].path == capture / "1.png" and opened.find("elsewhere/2.png") == 2 and opened.find("9.png") is None
    assert np.allclose(opened[2].camera.camera_to_world[:3, 3], [0.6, 0, 0])
    last = opened[1:]
    assert (
        isinstance(last, zipsplat.Capture) and len(last) == 2 and last.find("2.png") == 1 and last.find("0.png") is None
    )
    assert np.array_equal(last.cameras.Ks, opened.cameras.Ks[1:])
    with pytest.raises(zipsplat.FileError):
        zipsplat.Capture.open(capture / "none")


def test_captures_are_made_of_cameras_and_saved(capture: Path, tmp_path: Path) -> None:
    opened = zipsplat.Capture.open(capture)
    names, paths = [view.name for view in opened], [capture / view.name for view in opened]
    made = zipsplat.Capture.from_cameras(opened.cameras, names, paths)
    assert [view.path for view in made] == paths and np.allclose(made.cameras.viewmats, opened.cameras.viewmats)
    (tmp_path / "saved").mkdir()
    made.save(tmp_path / "saved" / "transforms.json")
    saved = zipsplat.Capture.open(tmp_path / "saved")
    assert [view.path for view in saved] == paths and np.allclose(saved.cameras.Ks, opened.cameras.Ks)
    assert np.allclose(saved.cameras.camera_to_world, opened.cameras.camera_to_world)
    with pytest.raises(zipsplat.ArgumentError, match="2 of 3 photos"):
        made[1:].save(tmp_path / "part.json")
    with pytest.raises(zipsplat.ArgumentError, match="1 names"):
        zipsplat.Capture.from_cameras(opened.cameras, names[:1])


def test_a_colmap_model_is_read(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 80 60 70 71 40 30\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0.5 0 2 1 a.png\n\n2 1 0 0 0 -0.5 0 2 1 b.png\n\n")
    (tmp_path / "points3D.txt").write_text("")
    opened = zipsplat.Capture.open(tmp_path)
    assert [photo.name for photo in opened] == ["a.png", "b.png"] and opened[0].path is None
    assert np.allclose(opened[0].camera.camera_to_world[:3, 3], [-0.5, 0, -2]) and opened[0].camera.fy == 71


def test_a_page_shows_the_scene(scene: zipsplat.Scene, tmp_path: Path) -> None:
    page = scene.show(height=321)
    frame = page._repr_html_()
    assert frame.startswith("<iframe srcdoc=") and "321px" in frame and "<script" not in frame, "the page is escaped"
    page.save(tmp_path / "page.html")
    assert "<meta name=generator content=zipsplat>" in (tmp_path / "page.html").read_text()
    assert f"{len(scene):,}" in scene._repr_html_() and f"{len(scene):,}" in repr(scene)


def test_evaluation_and_camera_estimation_use_the_command(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    found = zipsplat.evaluate(capture, views=2, options=("--size", "70x70"))
    assert 0 < found.psnr < 99 and 0 < found.ssim <= 1 and len(found.report["views"]) == 1
    with pytest.raises(zipsplat.CommandError, match="none"):
        zipsplat.evaluate(tmp_path / "none")
    double = tmp_path / "double"
    made = json.dumps(json.loads((capture / "transforms.json").read_text()))
    result = json.dumps({"warnings": ["few photos"], "result": None})
    double.write_text(f"#!/bin/sh\nfor last; do :; done\ncat > \"$last\" <<'END'\n{made}\nEND\necho '{result}'\n")
    double.chmod(double.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("ZIPSPLAT_COMMAND", str(double))
    assert len(zipsplat.estimate_cameras(capture)) == 3
    assert (caplog.records[-1].name, caplog.records[-1].message) == ("zipsplat", "few photos")
    monkeypatch.setenv("ZIPSPLAT_COMMAND", str(tmp_path / "missing"))
    with pytest.raises(zipsplat.CommandError, match="ZIPSPLAT_COMMAND"):
        zipsplat.estimate_cameras([os.fspath(capture)])


def test_render_requires_cameras(scene: zipsplat.Scene) -> None:
    for wrong in ("x", 7):
        with pytest.raises(TypeError, match="cameras: found .*, expected a Camera or a sequence of cameras"):
            scene.render(wrong)
