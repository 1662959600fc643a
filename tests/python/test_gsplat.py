"""gsplat's `rasterization`: rules, shapes, gradients."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zipsplat
from zipsplat import _rasterize

GOLDENS = Path(os.environ["ZIPSPLAT_GOLDENS"])
RASTERS = sorted(GOLDENS.glob("grad_raster.*.safetensors"))


def tensors(path: Path) -> dict[str, np.ndarray]:
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    kinds = {"F32": np.float32, "F64": np.float64, "U32": np.uint32, "I32": np.int32, "I64": np.int64, "U8": np.uint8}
    found = {}
    for name, at in header.items():
        if name != "__metadata__" and at["dtype"] in kinds:
            first, last = at["data_offsets"]
            found[name] = np.frombuffer(data[8 + size + first : 8 + size + last], kinds[at["dtype"]]).reshape(
                at["shape"]
            )
    return found


def apart(got: Any, truth: Any) -> float:
    """Returns the relative rms difference."""
    got, truth = np.asarray(got, np.float64), np.asarray(truth, np.float64)
    assert got.shape == truth.shape
    return float(np.sqrt(np.sum((got - truth) ** 2) / max(np.sum(truth**2), 1e-300)))


def of_pose(d_view: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Projects a gradient by viewmats onto rigid motions."""
    turn = -np.cross(view[:, :3], d_view[:, :3], axis=1).sum(axis=2)
    return np.concatenate([turn, -d_view[:, :3, 3]], axis=1)


@pytest.mark.skipif(not RASTERS, reason="no goldens")
@pytest.mark.parametrize("path", RASTERS, ids=lambda path: path.name.split(".")[1])
def test_images_and_gradients_match_goldens(path: Path) -> None:
    golden = tensors(path)
    width, height = (int(size) for size in golden["size_wh"])
    degree = int(np.sqrt(golden["sh"].shape[1])) - 1
    background = np.stack([golden["bg"]] * len(golden["viewmats"]))
    fields = [golden[name] for name in ("means", "quats", "scales", "opacities", "sh", "viewmats", "Ks")]
    hard = "hard" in path.name
    for mode in ("classic", "antialiased"):
        if f"{mode}/v_rgb" not in golden:
            continue
        how = dict(sh_degree=degree, rasterize_mode=mode, backgrounds=background)
        colors, alphas, meta = zipsplat.rasterization(*fields, width, height, render_mode="RGB+D", **how)
        stable = golden[f"{mode}/v_alpha"] != 0
        assert colors.shape == (2, height, width, 4) and alphas.shape == (2, height, width, 1)
        assert (meta["width"], meta["n_cameras"]) == (width, 2)
        for got, name in [(colors[..., :3], "rgb"), (colors[..., 3], "D"), (alphas[..., 0], "alpha")]:
            truth = golden[f"{mode}/{name}"]
            assert apart(got[stable], truth[stable]) < 3e-5, name
        expected, _, _ = zipsplat.rasterization(*fields, width, height, render_mode="ED", **how)
        assert apart(expected[..., 0][stable], golden[f"{mode}/ED"][stable]) < 3e-4
        # The background is its color times the transmittance.
        weights = [golden[f"{mode}/v_{name}"] for name in ("rgb", "alpha", "depth")]
        weights[1] = weights[1] - weights[0] @ golden["bg"].astype(np.float64)
        settings = _rasterize.Settings(width, height, mode == "antialiased", zipsplat.default_device())
        found, views = _rasterize.backward(settings, fields[:4], fields[4], fields[5], fields[6], weights, True)
        allowed = 3e-4 if hard else 5e-5
        for name in ("means", "quats", "scales", "opacities"):
            assert apart(found[name], golden[f"{mode}/all/d_{name}"]) < allowed, (mode, name)
        assert apart(found["sh_coeffs"], golden[f"{mode}/all/d_sh"]) < allowed
        assert views is not None
        got, truth = of_pose(views, fields[5]), of_pose(golden[f"{mode}/all/d_viewmats"], fields[5])
        assert apart(got, truth) < (1e-2 if hard else 1e-4)


def place(count: int = 40, views: int = 2, seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    viewmats = np.stack([np.eye(4)] * views).astype(np.float32)
    viewmats[:, 0, 3] = np.linspace(-0.3, 0.3, views)
    return {
        "means": (rng.normal(size=(count, 3)) * [0.8, 0.6, 0.4] + [0, 0, 3]).astype(np.float32),
        "quats": rng.normal(size=(count, 4)).astype(np.float32),
        "scales": rng.uniform(0.05, 0.3, (count, 3)).astype(np.float32),
        "opacities": rng.uniform(0.1, 0.95, count).astype(np.float32),
        "colors": rng.normal(size=(count, 5)).astype(np.float32),
        "viewmats": viewmats,
        "Ks": np.stack([[[40.0, 0, 24], [0, 42.0, 16], [0, 0, 1]]] * views).astype(np.float32),
    }


def test_channels_are_any_number_and_any_sign() -> None:
    fields = place()
    whole, alphas, _ = zipsplat.rasterization(**fields, width=48, height=32)
    assert whole.shape == (2, 32, 48, 5) and whole.min() < -0.2
    for channel in range(5):
        one = {**fields, "colors": 2 * fields["colors"][:, channel : channel + 1]}
        alone, _, _ = zipsplat.rasterization(**one, width=48, height=32)
        assert np.allclose(alone[..., 0], 2 * whole[..., channel], atol=2e-5)
    lit, _, _ = zipsplat.rasterization(**fields, width=48, height=32, backgrounds=np.ones((2, 5)))
    assert np.allclose(lit, whole + 1 - alphas, atol=1e-6)
    own = np.stack([fields["colors"], 0.5 * fields["colors"]])
    both, _, _ = zipsplat.rasterization(**{**fields, "colors": own}, width=48, height=32)
    assert np.allclose(both[0], whole[0], atol=1e-6) and np.allclose(both[1], 0.5 * whole[1], atol=2e-5)
    depth, _, _ = zipsplat.rasterization(**fields, width=48, height=32, render_mode="D")
    more, _, _ = zipsplat.rasterization(**fields, width=48, height=32, render_mode="RGB+ED")
    assert depth.shape[-1] == 1 and more.shape[-1] == 6
    assert np.allclose(more[..., 5:] * alphas, depth, atol=1e-4)


def test_unsupported_and_invalid_arguments_raise() -> None:
    fields = place()
    for options in [
        {"eps2d": 0.1},
        {"sparse_grad": True},
        {"absgrad": True},
        {"distributed": True},
        {"camera_model": "fisheye"},
        {"covars": np.zeros((40, 3, 3))},
        {"with_ut": True},
        {"with_eval3d": True},
        {"radial_coeffs": np.zeros((2, 6))},
        {"tangential_coeffs": np.zeros((2, 2))},
        {"thin_prism_coeffs": np.zeros((2, 4))},
        {"ftheta_coeffs": 1},
        {"rolling_shutter": "ROLLING"},
        {"viewmats_rs": fields["viewmats"]},
    ]:
        with pytest.raises(NotImplementedError, match=next(iter(options))):
            zipsplat.rasterization(**fields, width=48, height=32, **options)
    for options, words in [
        ({"quats": fields["quats"][:3]}, r"quats: found shape \[3, 4\]"),
        ({"colors": fields["colors"][:3]}, "colors"),
        ({"sh_degree": 1}, "K, 3"),
        ({"backgrounds": np.zeros((2, 3))}, "backgrounds"),
        ({"render_mode": "N"}, "render_mode"),
        ({"viewmats": fields["viewmats"] + 1}, "viewmats"),
    ]:
        with pytest.raises(ValueError, match=words):
            zipsplat.rasterization(**{**fields, **options}, width=48, height=32)
    _, _, meta = zipsplat.rasterization(**fields, width=48, height=32)
    with pytest.raises(KeyError, match="isect_ids: .*means2d"):
        meta["isect_ids"]


def test_planes_and_small_radii_cull() -> None:
    fields, size = place(), {"width": 48, "height": 32}
    _, alphas, meta = zipsplat.rasterization(**fields, **size, packed=False)
    assert meta["means2d"].shape == meta["radii"].shape == (2, 40, 2) and meta["depths"].shape == (2, 40)
    far, clip = float(np.median(meta["depths"])), int(np.median(meta["radii"]))
    for options, kept in [
        ({"far_plane": far}, meta["depths"] <= far),
        ({"near_plane": far}, meta["depths"] >= far),
        ({"radius_clip": clip}, (meta["radii"] > clip).any(-1)),
    ]:
        _, culled, packed = zipsplat.rasterization(**fields, **size, **options)
        kept &= (meta["radii"] > 0).all(-1)
        assert np.array_equal(np.stack([packed["camera_ids"], packed["gaussian_ids"]]), np.nonzero(kept))
        for view, chosen in enumerate(kept):
            assert 0 < chosen.sum() < 40
            part = {name: array[chosen] for name, array in fields.items() if len(array) == 40}
            part |= {name: fields[name][view : view + 1] for name in ("viewmats", "Ks")}
            assert np.array_equal(zipsplat.rasterization(**part, **size)[1][0], culled[view])
        assert not np.array_equal(culled, alphas)


def test_batches_are_scenes_with_their_cameras() -> None:
    scenes, size = [place(seed=1), place(seed=2)], {"width": 48, "height": 32}
    batch = {name: np.stack([scene[name] for scene in scenes])[:, None] for name in scenes[0]}
    own = {**batch, "colors": np.stack([batch["colors"], 0.5 * batch["colors"]], 2)}
    background = np.ones((2, 1, 2, 5))
    for fields in (batch, own):
        colors, alphas, meta = zipsplat.rasterization(
            **fields, **size, packed=False, backgrounds=background, render_mode="RGB+D"
        )
        assert colors.shape == (2, 1, 2, 32, 48, 6) and alphas.shape == (2, 1, 2, 32, 48, 1)
        assert meta["means2d"].shape == (2, 1, 2, 40, 2) and (meta["n_batches"], meta["n_cameras"]) == (2, 2)
        for i in range(2):
            one = {name: array[i, 0] for name, array in fields.items()}
            alone = zipsplat.rasterization(
                **one, **size, packed=False, backgrounds=background[0, 0], render_mode="RGB+D"
            )
            assert np.array_equal(alone[0], colors[i, 0]) and np.array_equal(alone[1], alphas[i, 0])
            assert np.array_equal(alone[2]["radii"], meta["radii"][i, 0])
    with pytest.raises(zipsplat.ArgumentError, match=r"scales: found shape \[2, 40, 3\], expected \[2, 1, 40, 3\]"):
        zipsplat.rasterization(**{**batch, "scales": batch["scales"][:, 0]}, **size)


def test_strategies_of_gsplat_add_gaussians() -> None:
    torch = pytest.importorskip("torch")
    strategies = pytest.importorskip("gsplat.strategy")
    fields = {name: torch.from_numpy(array) for name, array in place().items()}
    target = 0.5 + 0.5 * zipsplat.rasterization(**fields, width=48, height=32)[0]
    grown = []
    for packed in (False, True):
        names = ("means", "quats", "scales", "opacities", "colors")
        params = torch.nn.ParameterDict({name: fields[name].clone() for name in names})
        params["scales"], params["opacities"] = params["scales"].log(), params["opacities"].logit()
        adam = {name: torch.optim.Adam([{"params": params[name], "name": name}], lr=1e-3) for name in names}
        strategy = strategies.DefaultStrategy(refine_start_iter=2, refine_every=4, grow_grad2d=1e-4, reset_every=100)
        state = strategy.initialize_state(scene_scale=1.0)
        torch.manual_seed(1)
        for step in range(6):
            given = {**params, "scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid()}
            places = {"viewmats": fields["viewmats"], "Ks": fields["Ks"]}
            colors, _, info = zipsplat.rasterization(**given, **places, width=48, height=32, packed=packed)
            strategy.step_pre_backward(params, adam, state, step, info)
            torch.nn.functional.l1_loss(colors, target).backward()
            for optimizer in adam.values():
                optimizer.step()
                optimizer.zero_grad()
            strategy.step_post_backward(params, adam, state, step, info, packed=packed)
        grown.append(len(params["means"]))
    assert grown[0] == grown[1] > 40


def reference(fields: dict[str, Any], width: int, height: int) -> tuple[Any, Any, dict[str, Any]]:
    """Returns colors, alphas and metadata of gsplat's torch reference, blending every Gaussian into
    every pixel."""
    torch = pytest.importorskip("torch")
    impl = pytest.importorskip("gsplat.cuda._torch_impl")
    covars, _ = impl._quat_scale_to_covar_preci(fields["quats"], fields["scales"], compute_preci=False)
    radii, means2d, depths, conics, _ = impl._fully_fused_projection(
        fields["means"], covars, fields["viewmats"], fields["Ks"], width, height
    )
    means2d.retain_grad()
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pictures, alphas = [], []
    for camera in range(len(depths)):
        color, left = torch.zeros(height, width, fields["colors"].shape[-1]), torch.ones(height, width)
        done = torch.zeros(height, width, dtype=torch.bool)
        for n in torch.argsort(depths[camera], stable=True).tolist():
            if (radii[camera, n] <= 0).any():
                continue
            dx, dy = x - means2d[camera, n, 0], y - means2d[camera, n, 1]
            a, b, c = conics[camera, n]
            alpha = (fields["opacities"][n] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(
                max=0.999
            )
            drawn = (alpha >= 1 / 255) & ~done
            done = done | drawn & (left * (1 - alpha) <= 1e-4)
            alpha = torch.where(drawn & ~done, alpha, torch.zeros_like(alpha))
            color = color + (alpha * left)[..., None] * fields["colors"][n]
            left = left * (1 - alpha)
        pictures.append(color)
        alphas.append(1 - left)
    meta = {"means2d": means2d, "radii": radii, "depths": depths, "conics": conics}
    return torch.stack(pictures), torch.stack(alphas)[..., None], meta


def test_tensors_match_gsplats_images_and_gradients() -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("gsplat.cuda._torch_impl")
    fields = {name: torch.from_numpy(array) for name, array in place(25).items()}
    for name in fields:
        fields[name].requires_grad_(name != "Ks")
    width, height = 48, 32
    rng = np.random.default_rng(5)
    weights = [torch.from_numpy(rng.normal(size=(2, height, width, size)).astype(np.float32)) for size in (5, 1)]

    def gradients(colors: Any, alphas: Any) -> dict[str, Any]:
        for tensor in fields.values():
            tensor.grad = None
        (torch.sum(colors * weights[0]) + torch.sum(alphas * weights[1])).backward()
        return {name: tensor.grad.numpy().copy() for name, tensor in fields.items() if tensor.grad is not None}

    colors, alphas, meta = zipsplat.rasterization(**fields, width=width, height=height, packed=False)
    *expected, expected_meta = reference(fields, width, height)
    seen = (meta["radii"] > 0).all(-1)
    assert seen.any() and (expected_meta["radii"] >= meta["radii"]).all()
    for name in ("means2d", "depths", "conics"):
        assert apart(meta[name][seen].detach(), expected_meta[name][seen].detach()) < 1e-6, name
    assert isinstance(colors, torch.Tensor) and colors.requires_grad
    off = (np.abs(colors.detach().numpy() - expected[0].detach().numpy()) > 1e-4).mean()
    assert off < 2e-3, "all but a few pixels at a threshold"
    assert apart(alphas.detach(), expected[1].detach()) < 1e-3
    # Rounding crosses a threshold elsewhere.
    same = (torch.abs(colors - expected[0]).amax(-1, keepdim=True) < 1e-4).float().detach()
    weights = [weight * same for weight in weights]
    got, truth = gradients(colors, alphas), gradients(*expected)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert apart(got[name], truth[name]) < 2e-3, name
    views = fields["viewmats"].detach().numpy()
    assert apart(of_pose(got["viewmats"], views), of_pose(truth["viewmats"], views)) < 2e-3
    assert apart(meta["means2d"].grad, expected_meta["means2d"].grad) < 2e-3


def test_torch_optimizers_recover_colors() -> None:
    torch = pytest.importorskip("torch")
    fields = {name: torch.from_numpy(array) for name, array in place().items()}
    target, _, _ = zipsplat.rasterization(**fields, width=48, height=32)
    fields["colors"] = torch.zeros_like(fields["colors"], requires_grad=True)
    adam = torch.optim.Adam([fields["colors"]], lr=0.1)
    losses = []
    for _ in range(30):
        drawn, _, _ = zipsplat.rasterization(**fields, width=48, height=32)
        loss = torch.mean((drawn - target) ** 2)
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.05 * losses[0]
