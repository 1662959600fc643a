"""Photos to scenes: inputs of Python, cameras, and the command's exact bits."""

from __future__ import annotations

import ctypes
import io
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zipsplat
from conftest import PHOTOS, SIZE, same
from zipsplat import _native

POINTS = """ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
0 0 7
"""


def command(*arguments: object) -> None:
    program = os.environ["ZIPSPLAT_COMMAND"]
    done = subprocess.run([program, "--quiet", *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_kept_features_give_other_scenes_and_patch_tokens(model: zipsplat.Model, photos: list[Path]) -> None:
    whole = model.reconstruct(photos, input_size=SIZE, keep_features=True)
    half = model.reconstruct(photos, input_size=SIZE, ratio=0.5)
    assert same(whole.again(ratio=0.5), half)
    assert same(whole.again(ratio=0.5).again(), whole)
    rows, columns = SIZE[1] // model.patch_size, SIZE[0] // model.patch_size
    assert whole.patch_tokens.shape == (len(photos), rows, columns, whole.channel_count)
    with pytest.raises(zipsplat.ArgumentError, match="without features"):
        half.again()
    with pytest.raises(zipsplat.ArgumentError, match="keep_features"):
        model.reconstruct(photos, input_size=SIZE, keep_features=True, block_size=len(photos) - 1)
    with pytest.raises(zipsplat.ArgumentError, match="ratio"):
        whole.again(ratio=-1)


def rows(ply: bytes) -> bytes:
    """Returns a PLY's Gaussians without the header, which may name the scene's world."""
    return ply.split(b"end_header\n", 1)[1]


def test_images_are_paths_bytes_pil_images_or_arrays(
    model: zipsplat.Model, photos: list[Path], scene: zipsplat.Scene
) -> None:
    image = pytest.importorskip("PIL.Image")
    arrays = [zipsplat.load_image(photo) for photo in photos]
    floats = [array.astype(np.float32) / 255 for array in arrays]
    pillow = [image.open(io.BytesIO(np_png(array))) for array in arrays]
    cases = {
        "bytes": [photo.read_bytes() for photo in photos],
        "uint8": arrays,
        "float32": floats,
        "bottom up": [np.ascontiguousarray(array[::-1])[::-1] for array in arrays],
        "gaps": [np.repeat(array, 2, axis=1)[:, ::2] for array in arrays],
        "pillow": pillow,
    }
    for name, images in cases.items():
        assert same(model.reconstruct(images, input_size=SIZE), scene), name
    shared = np.broadcast_to(arrays[0][0], arrays[0].shape)
    assert same(model.reconstruct([shared], input_size=SIZE), model.reconstruct([shared.copy()], input_size=SIZE))


def np_png(array: np.ndarray) -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        zipsplat.save_image(Path(folder) / "a.png", array)
        return (Path(folder) / "a.png").read_bytes()


def test_torch_tensors_are_read(model: zipsplat.Model, photos: list[Path], scene: zipsplat.Scene) -> None:
    torch = pytest.importorskip("torch")
    warnings.simplefilter("error")  # torch warns of arrays that are not writable.
    tensors = [torch.from_numpy(zipsplat.load_image(photo)) for photo in photos]
    assert same(model.reconstruct(tensors, input_size=SIZE), scene)
    with pytest.raises(ValueError, match=r"permute\(1, 2, 0\)"):
        model.reconstruct([tensor.permute(2, 0, 1) for tensor in tensors], input_size=SIZE)


def test_anything_with_dlpack_is_read(model: zipsplat.Model, photos: list[Path], scene: zipsplat.Scene) -> None:
    class Foreign:
        def __init__(self, array: np.ndarray) -> None:
            self.array = array.copy()

        def __dlpack__(self, **how: object) -> object:
            return self.array.__dlpack__(**how)

        def __dlpack_device__(self) -> object:
            return self.array.__dlpack_device__()

    foreign = [Foreign(zipsplat.load_image(photo)) for photo in photos]
    assert same(model.reconstruct(foreign, input_size=SIZE), scene)


def test_a_folder_matches_the_command_bitwise(model: zipsplat.Model, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, photo in zip((10, 9, 1), zipsplat.list_images(PHOTOS)):
        (folder / f"{i}.jpg").write_bytes(photo.read_bytes())
    (folder / "notes.txt").write_text("left out")
    command("reconstruct", folder, "--size", "70x70", "-o", tmp_path / "command.ply")
    made = model.reconstruct(folder, input_size=SIZE).to_bytes("ply")
    assert rows(made) == rows((tmp_path / "command.ply").read_bytes())


def test_a_capture_matches_the_command_bitwise(model: zipsplat.Model, capture: Path) -> None:
    written = capture / "command.ply"
    options = ("--size", "70x70", "--world", "cameras")
    command("reconstruct", *sorted(capture.glob("?.png")), "--cameras", capture, *options, "-o", written)
    opened = zipsplat.Capture.open(capture)
    expected = model.reconstruct(opened, input_size=SIZE)
    assert rows(expected.to_bytes("ply")) == rows(written.read_bytes())
    paths = sorted(capture.glob("?.png"))
    assert same(model.reconstruct(paths, capture / "transforms.json", input_size=SIZE), expected)
    assert same(model.reconstruct(paths, opened, input_size=SIZE), expected)
    # Without points or other cameras in the file, the result is the same.
    assert same(model.reconstruct(paths, opened.cameras, input_size=SIZE), expected)
    part = model.reconstruct(paths[1:], opened, input_size=SIZE)
    assert same(model.reconstruct(opened[1:], input_size=SIZE), part) and not same(part, expected)
    # Points set the scale.
    (capture / "points.ply").write_text(POINTS)
    command("reconstruct", *paths, "--cameras", capture, *options, "-o", capture / "points-command.ply")
    with_points = model.reconstruct(zipsplat.Capture.open(capture), input_size=SIZE)
    assert rows(with_points.to_bytes("ply")) == rows((capture / "points-command.ply").read_bytes())
    assert not same(with_points, expected)
    first = model.reconstruct(opened, input_size=SIZE, world="first_camera")
    assert not same(model.reconstruct(opened, input_size=SIZE, scene_scale=2.0), expected)
    assert np.allclose(first.means, expected.means, atol=1e-5), "the first camera is the world's origin here"
    from_file = zipsplat.Scene.open(written)
    assert from_file.world == "input_cameras" and expected.world is None
    assert zipsplat.Scene.from_bytes(from_file.to_bytes("spz")).world == "input_cameras"
    pictures = from_file.render(opened.cameras)
    command("render", written, "--cameras", capture / "transforms.json", "-o", capture / "drawn")
    drawn = [zipsplat.load_image(capture / "drawn" / f"00{i}.png") for i in range(3)]
    assert np.array_equal(pictures.rgb, drawn)


def test_photos_without_a_camera_are_skipped(model: zipsplat.Model, capture: Path) -> None:
    extra = capture / "other.png"
    extra.write_bytes((capture / "1.png").read_bytes())
    paths = [extra, *(capture / f"{i}.png" for i in range(2))]
    known = model.reconstruct([capture / "0.png", capture / "1.png"], capture, input_size=SIZE)
    assert same(model.reconstruct(paths, capture, input_size=SIZE), known)
    with pytest.raises(ValueError, match="none of 1 photos"):
        model.reconstruct([extra], capture, input_size=SIZE)


def test_refinement_reduces_the_error(model: zipsplat.Model, capture: Path, tmp_path: Path) -> None:
    opened = zipsplat.Capture.open(capture)
    told: list[zipsplat.Progress] = []
    coarse = model.reconstruct(opened, input_size=SIZE)
    sharp = coarse.refine(opened, steps=15, progress=told.append)
    assert sharp.refinement is not None and sharp.refinement.steps == 15
    assert sharp.refinement.final_loss < sharp.refinement.initial_loss
    assert sharp.refinement.best_training_psnr > sharp.refinement.initial_training_psnr
    assert [now.step for now in told] == list(range(1, 16)) and (told[-1].steps, told[-1].fraction) == (15, 1.0)
    assert told[-1].loss == sharp.refinement.final_loss
    photos = np.stack([zipsplat.load_image(capture / f"{i}.png") for i in range(3)]).astype(float)

    def apart(scene: zipsplat.Scene) -> float:
        return float(np.mean((scene.render(opened.cameras).rgb - photos) ** 2))

    assert apart(sharp) < apart(coarse)
    assert np.array_equal(sharp.refinement.cameras.camera_to_world, opened.cameras.camera_to_world)
    with pytest.raises(zipsplat.ArgumentError, match="exposure"):
        coarse.refine(opened, steps=1, exposure="of")  # type: ignore[arg-type]
    exposed = coarse.refine(opened, steps=15, exposure="on")
    assert not same(exposed, sharp)
    assert exposed.refinement is not None and sharp.refinement is not None
    identity = np.tile(np.eye(3, 4, dtype=np.float32), (len(opened.cameras), 1, 1))
    assert np.array_equal(sharp.refinement.exposures, identity)
    assert not np.array_equal(exposed.refinement.exposures, identity)
    masks = np.ones((3, *photos.shape[1:3]), bool)
    masks[:, :, :10] = False
    masked = coarse.refine(opened, steps=15, masks=masks)
    assert not same(masked, sharp) and same(masked, coarse.refine(opened, steps=15, masks=~masks, invert_masks=True))
    folder = tmp_path / "masks"
    folder.mkdir()
    for i, mask in enumerate(masks):
        zipsplat.save_image(folder / f"{i}.png", np.repeat(mask[:, :, None], 3, 2).astype(np.uint8) * 255)
    assert same(masked, coarse.refine(opened, steps=15, masks=folder))
    assert len(model.reconstruct(opened, input_size=SIZE, masks=folder)) <= len(coarse)
    with pytest.raises(zipsplat.ArgumentError, match="mask 0"):
        coarse.refine(opened, steps=1, masks=masks[:, :-1])
    state = tmp_path / "state"
    coarse.refine(opened, steps=15, checkpoint=state, progress=lambda now: now.step < 5)
    told.clear()
    resumed = coarse.refine(opened, steps=15, checkpoint=state, progress=told.append)
    assert len(told) == 10 and same(resumed, sharp)
    assert coarse.refine(opened, steps=2, antialiased=True).antialiased and not sharp.antialiased
    depths = [None, np.full(photos.shape[1:3], 2.0), np.full(photos.shape[1:3], 2.0)]
    assert not same(coarse.refine(opened, steps=15, depths=depths), sharp)
    for wrong, word in ((depths[:2], "2 depths"), ([None, depths[1][1:], None], "depth 1"), ([None] * 3, "NULL in all")):
        with pytest.raises(zipsplat.ArgumentError, match=word):
            coarse.refine(opened, steps=1, depths=wrong)
    with pytest.raises(zipsplat.ArgumentError, match="no alpha channel"):
        coarse.refine(opened, steps=1, masks="alpha")
    moved = coarse.refine(opened, steps=15, optimize_cameras=True).refinement
    assert moved is not None and not np.array_equal(moved.cameras.camera_to_world, opened.cameras.camera_to_world)
    assert np.allclose(moved.cameras[0].camera_to_world, opened.cameras[0].camera_to_world)


def test_tokens_are_refined_and_cameras_estimated(photos: list[Path], capture: Path) -> None:
    with zipsplat.Model.load(tokens=True) as model:
        opened = zipsplat.Capture.open(capture)
        made = model.reconstruct(opened, input_size=SIZE)
        refined = made.refine(opened, steps=2, target="tokens")
        assert refined.refinement is not None and refined.refinement.steps == 2 and len(refined) == len(made)
        with pytest.raises(zipsplat.ArgumentError, match="tokens"):
            refined.refine(opened, steps=2, target="tokens")
        unposed = model.reconstruct(photos, input_size=SIZE)
    assert unposed.token_count * model.gaussians_per_token == len(unposed)
    estimates = unposed.estimate_cameras()
    assert len(estimates) == len(photos) and estimates[0].camera is not None
    assert estimates[0].inliers > estimates[0].patches / 2
    assert np.allclose(estimates[0].camera.camera_to_world[:3, 3], 0, atol=0.5)
    height, width, _ = zipsplat.load_image(photos[0]).shape
    assert (estimates[0].camera.height, estimates[0].camera.width) == (height, width)
    unposed.close()
    with pytest.raises(zipsplat.ArgumentError, match="Reconstruction: found a closed one"):
        unposed.estimate_cameras()
    assert unposed.render(estimates[0].camera).rgb.any()


def test_progress_functions_stop_and_raise(model: zipsplat.Model, photos: list[Path], capture: Path) -> None:
    told: list[float] = []

    def stop(now: zipsplat.Progress) -> bool:
        told.append(now.fraction)
        return len(told) < 3

    with pytest.raises(zipsplat.CancelledError) as stopped:
        model.reconstruct(photos, input_size=SIZE, progress=stop)
    assert (stopped.value.status, stopped.value.name, len(told)) == (9, "ZS_ERROR_CANCELLED", 3)

    def fail(_now: zipsplat.Progress) -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        model.reconstruct(photos, input_size=SIZE, progress=fail)
    opened = zipsplat.Capture.open(capture)
    place = zipsplat.Scene.open(capture / "place.ply")
    scene = zipsplat.Scene.from_arrays(place.means, place.scales, place.quats, place.opacities, place.sh_coeffs + 0.3)
    with pytest.raises(zipsplat.ArgumentError, match="steps: found 0"):
        scene.refine(opened, steps=0)
    with pytest.raises(zipsplat.ArgumentError, match="seconds: found 0"):
        scene.refine(opened, seconds=0)
    timed = scene.refine(opened, seconds=1e-9).refinement
    assert timed is not None and timed.steps == 1
    best = scene.refine(opened, steps=9, progress=lambda now: now.step < 2)
    assert best.refinement is not None and (best.refinement.stop_reason, best.refinement.steps) == ("stopped", 2)
    with pytest.raises(KeyError, match="mine"):
        scene.refine(opened, steps=9, progress=fail)
    assert same(model.reconstruct(photos, input_size=SIZE), model.reconstruct(photos, input_size=SIZE)), (
        "it goes on working"
    )


def test_invalid_arguments_raise(model: zipsplat.Model, photos: list[Path], capture: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    camera = zipsplat.Camera.from_fov(8, 8)
    picture = np.zeros((8, 8, 3), np.uint8)
    cases: list[tuple[object, dict[str, object], type[Exception], str]] = [
        ([tmp_path / "none.png"], {}, zipsplat.FileError, "none.png"),
        ([b"no picture"], {}, zipsplat.FormatError, "PNG"),
        (empty, {}, ValueError, "found none"),
        ([], {}, zipsplat.ArgumentError, "images"),
        (picture, {}, TypeError, "sequence"),
        ([picture[..., 0]], {}, ValueError, r"image 0: found shape \[8, 8\]"),
        ([picture.astype(np.int32)], {}, TypeError, "int32"),
        ([picture], {"ratio": 1.5}, zipsplat.ArgumentError, "ratio"),
        ([picture], {"ratio": 0}, ValueError, "ratio: found 0"),
        ([picture], {"scene_scale": -1.0}, ValueError, "scene_scale: found -1.0"),
        ([picture], {"token_selection": "best"}, ValueError, "'kmeans', 'mutual', 'stride', 'random'"),
        ([picture], {"world": "mine"}, ValueError, "first_camera"),
        ([picture], {"world": "input_cameras"}, zipsplat.ArgumentError, "world"),
        ([picture], {"input_size": (15, 14)}, zipsplat.ArgumentError, "size of the views"),
        ([picture], {"kv_pool": 0}, ValueError, "kv_pool: found 0, expected auto"),
        ([picture], {"block_size": 0}, ValueError, "block_size: found 0"),
        ([picture], {"block_size": 193}, ValueError, "block size: found 193"),
        ([picture], {"input_size": (0, 70)}, ValueError, "input_size: found 0"),
        ([picture], {"seed": -1}, ValueError, "seed: found -1"),
        ([picture], {"seed": "a"}, zipsplat.ArgumentTypeError, "seed: found 'a'"),
        ([picture], {"cameras": [camera, camera]}, ValueError, "found 2 cameras"),
        ([picture], {"cameras": [np.eye(4)]}, TypeError, "ndarray"),
        ([picture], {"cameras": empty}, zipsplat.ArgumentError, "transforms.json"),
        ([picture], {"cameras": capture}, TypeError, "paths"),
    ]
    with pytest.raises(zipsplat.FileError, match="none: No such file"):
        zipsplat.list_images(tmp_path / "none")
    for images, options, error, words in cases:
        with pytest.raises(error, match=words):
            model.reconstruct(images, **options)  # type: ignore[arg-type]


def test_models_have_properties_and_reject_invalid_weights(model: zipsplat.Model, tmp_path: Path) -> None:
    assert model.image_size % model.patch_size == 0 and model.precision == "fp32" and model.weight_bytes > 1e6
    assert "lvm" in repr(model).lower() or "cpu" in repr(model).lower() or model.device.info.name in repr(model)
    with pytest.raises(zipsplat.FileError):
        zipsplat.Model.load(tmp_path / "none")
    with pytest.raises(zipsplat.FormatError):
        zipsplat.Model.load(b"0" * 64)
    with pytest.raises(ValueError, match="'int8'"):
        zipsplat.Model.load(precision="most")
    with pytest.raises(zipsplat.CommandError, match="zipsplat weights get zipsplat"):
        zipsplat.Model.load("zipsplat")
    names = {info.name: info for info in zipsplat.list_models()}
    assert names["builtin"].path is None and names["da3-small"].license == "Apache-2.0"


def test_closed_objects_raise(photos: list[Path]) -> None:
    with zipsplat.Device() as device:
        model = zipsplat.Model.load(device=device)
    with model:
        scene = model.reconstruct(photos[:1], input_size=SIZE)
    model.close()
    for call in (lambda: model.reconstruct(photos), lambda: zipsplat.Renderer(scene), lambda: device.info):
        with pytest.raises(zipsplat.ArgumentError, match="(Model|Device): found a closed one"):
            call()
    with zipsplat.Renderer(scene, zipsplat.default_device()) as renderer:
        assert renderer.render(zipsplat.Camera.from_fov(8, 8)).rgb.shape == (8, 8, 3)


def test_a_lost_device_is_shared_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    lost = zipsplat.default_device()
    double = SimpleNamespace(zs_lost=lambda: 8, zs_last_error=lambda: None, zs_status_name=lambda _: None)
    monkeypatch.setattr(_native, "lib", double)
    with pytest.raises(zipsplat.DeviceLostError):
        _native.call("zs_lost")
    monkeypatch.undo()
    assert zipsplat.default_device() is not lost


def test_devices_are_opened_by_kind_uuid_and_name() -> None:
    info = zipsplat.default_device().info
    assert len(info.uuid) == 32 and info in zipsplat.list_devices()
    for device in (info.uuid, info.name, info.index, *(["cpu"] if info.kind == "cpu" else [])):
        assert zipsplat.Device(device).info == info
    with pytest.raises(zipsplat.NoDeviceError, match="no such card"):
        zipsplat.Device("no such card")


CUDA = """
#include <string.h>
int cuInit(unsigned flags) { return flags; }
int cuDeviceGet(int *device, int ordinal) { *device = ordinal + 5; return ordinal == 1 ? 0 : 101; }
int cuDeviceGetUuid(unsigned char *uuid, int device) { memcpy(uuid, (unsigned char[]){UUID}, 16); return device != 6; }
"""


@pytest.mark.skipif(shutil.which("cc") is None or sys.platform != "linux", reason="no C compiler")
def test_a_cuda_device_is_opened_by_its_uuid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = zipsplat.default_device().info
    digits = ", ".join(f"0x{info.uuid[at : at + 2]}" for at in range(0, 32, 2))
    (tmp_path / "cuda.c").write_text(CUDA.replace("UUID", digits))
    library = tmp_path / "libcuda.so.1"
    subprocess.run(["cc", "-shared", "-fPIC", tmp_path / "cuda.c", "-o", library], check=True)
    opened = ctypes.CDLL
    monkeypatch.setattr(ctypes, "CDLL", lambda name: opened(str(library) if name == "libcuda.so.1" else name))
    scene = zipsplat.Scene.from_arrays(*np.zeros((2, 0, 3)), np.zeros((0, 4)), np.zeros(0), np.zeros((0, 1, 3)))
    assert zipsplat.Renderer(scene, "cuda:1").device.info == info
    with pytest.raises(zipsplat.NoDeviceError, match="cuda:0: found CUDA error 101"):
        zipsplat.Device("cuda")


def test_every_failure_is_an_error_of_zipsplat() -> None:
    kinds = [kind for kind in vars(zipsplat).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    assert len(kinds) > 14 and all(issubclass(kind, zipsplat.Error) for kind in kinds)
