"""Compares the network with golden data, or writes a small golden for the engine's tests.

    python tools/train/check.py goldens FOLDER
    python tools/train/check.py dump WEIGHTS OUT.safetensors     # Gaussians for each ratio
"""

import argparse
import copy
from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from depth import DepthAnything3, architecture_from_json
from model import ZipSplat, nearest_tokens
from vggt import DEVIATION, MEAN, Aggregator
from weights import Architecture, load, seeded

# Bound on a tap's maximum error over the truth's RMS, from f32 rounding.
TOLERANCE = 3e-5

# Columns of packed Gaussians.
FIELDS = {"means": (0, 3), "scales": (3, 6), "quats": (6, 10), "opacities": (10, 11), "sh_coeffs": (11, None)}


def paper(name, width, depth, alt_start, out_layers, **changes):
    heads = max(width // 64, 1)
    fields = dict(
        name=name, width=width, depth=depth, heads=heads, ffn="gelu", ffn_hidden=4 * width, patch=14, position_grid=37,
        alt_start=alt_start, qk_norm_start=alt_start, rope_start=alt_start, out_layers=out_layers, camera_depth=4,
        camera_heads=16, camera_hidden=4 * width, camera_pose_hidden=width // 2, fusion_heads=heads,
        fusion_hidden=4 * width, color_width=128, color_heads=2, color_hidden=128, head_hidden=2 * (width + 128),
        gaussians_per_token=32, sh_degree=1,
    )  # fmt: skip
    return Architecture(**{**fields, **changes})


GOLDENS = [
    paper("tiny", 128, 6, 2, (3, 4, 5)),
    paper("tiny_swiglu", 128, 6, 3, (1, 3, 5), ffn="swiglu", ffn_hidden=344, qk_norm_start=2, rope_start=4),
    paper("micro", 64, 3, 1, (1, 2), position_grid=5, color_width=32, color_heads=1, color_hidden=64, head_hidden=192,
          gaussians_per_token=4, sh_degree=2),
]  # fmt: skip


# The dictionary has the reference view of each golden.
DEPTH = """{"name": "da3_tiny", "features": 32, "channels": [16, 24, 32, 48], "backbone": {"width": 128, "depth": 6,
    "heads": 2, "ffn": "gelu", "ffn_hidden": 512, "patch": 14, "position_grid": 37, "alt_start": 2, "qk_norm_start": 2,
    "rope_start": 2, "out_layers": [2, 3, 4, 5]}}"""
DEPTH_GOLDENS = {"v1": 0, "v2": 0, "v3": 1}


# Tiny aggregators: width, heads, blocks of the embedding, pairs, side of the position grid; pairs
# with features; cases.
VGGT = {
    "vggt_tiny": ((64, 2, 3, 5, 37), (1, 2, 3, 4), ("v1", "v2", "v3")),
    "vggt_micro": ((32, 1, 2, 3, 4), (0, 1, 1, 2), ("v3", "native", "up")),
}


def golden_model(architecture):
    model = ZipSplat(architecture).double()
    state = {name: seeded(architecture.name, name, tuple(p.shape)) for name, p in model.state_dict().items()}
    model.load_state_dict(state)
    return model.eval()


def priors_of(golden):
    if "in/pose" not in golden:
        return None
    poses = torch.eye(4).repeat(len(golden["in/pose"]), 1, 1)
    poses[:, :3, :3] = golden["in/pose"][:, :9].unflatten(1, (3, 3))
    poses[:, :3, 3] = golden["in/pose"][:, 9:]
    return poses[None], golden["in/camera"][None, :, 2:]


@torch.no_grad()
def compare(model, golden):
    """Returns {tap: maximum error / RMS} at every ratio, with the golden's kept tokens."""
    dtype = model.color_embed.proj.weight.dtype
    images = (golden["in/images_u8"].float() / 255).to(dtype)[None]
    priors = priors_of(golden)
    if priors is not None:
        priors = tuple(x.to(dtype) for x in priors)
    taps = {}
    layers, color = model.prepare(images, priors, taps=taps)
    for prefix in sorted({name.split("/")[0] for name in golden if name.startswith("r")}):
        forced = golden[f"{prefix}/nearest_idx"][None]
        fused = {}
        fused["gauss"], _ = model.decode(layers, color, indices=forced, taps=fused)
        taps |= {f"{prefix}/{name}": value for name, value in fused.items()}
    errors = {}
    for name, truth in golden.items():
        if name in taps:
            errors[name] = deviation(taps[name].double().reshape(truth.shape), truth.double()).item()
    return errors


def depth_model():
    model = DepthAnything3(architecture_from_json(DEPTH)).double()
    state = {name: seeded("da3_tiny", f"model.{name}", tuple(p.shape)) for name, p in model.state_dict().items()}
    model.load_state_dict(state)
    return model.eval()


@torch.no_grad()
def compare_depth(model, golden, reference):
    """Returns {tap: maximum error / RMS} of features, heads and cameras."""
    images = golden["in/images_u8"].to(model.head.norm.weight.dtype) / 255
    mean, deviations = (images.new_tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
    features, tokens = model.features((images - mean) / deviations, reference)
    depth, rays, cameras = model.heads(features, tokens, images.shape[-2:])
    taps = {f"bb/feat{i}": feature for i, feature in enumerate(features)}
    taps |= {"bb/cam_feat": tokens, "head/logits": depth, "head/logits_aux": rays, "cam/encoding": cameras}
    return {name: deviation(found.double(), golden[name].double()).item() for name, found in taps.items()}


def vggt_architecture(name):
    (width, heads, embedding, pairs, grid), outputs, _ = VGGT[name]
    layers = tuple(embedding + 2 * pair + 1 for pair in sorted(set(outputs)))
    return paper(name, width, embedding + 2 * pairs, embedding, layers, heads=heads, position_grid=grid, family="vggt")


def aggregator(name):
    model = Aggregator(vggt_architecture(name)).double()
    state = {key: seeded(name, f"aggregator.{key}", tuple(p.shape)) for key, p in model.state_dict().items()}
    model.load_state_dict(state)
    return model.eval()


@torch.no_grad()
def compare_aggregator(model, golden):
    """Returns {tap: maximum error / RMS} of tokens and features."""
    taps = {}
    model((golden["in/images_u8"].to(model.camera_token.dtype) / 255)[None], taps)
    for j, pair in enumerate(VGGT[model.architecture.name][1]):
        taps[f"agg/feat{j}"] = torch.cat((taps[f"agg/frame{pair}"], taps[f"agg/global{pair}"]), -1)
    taps = {name: value.double() for name, value in taps.items() if name in golden}
    return {name: deviation(value.reshape(golden[name].shape), golden[name].double()).item() for name, value in taps.items()}


def deviation(found, truth):
    return (found - truth).abs().max() / truth.square().mean().sqrt()


def cases(folder):
    """Yields file, model and comparison of each golden."""
    for architecture in GOLDENS:
        for path in sorted(Path(folder).glob(f"{architecture.name}.v*.safetensors")):
            yield path, golden_model(architecture), compare
    for case, reference in DEPTH_GOLDENS.items():
        yield Path(folder) / f"da3_tiny.{case}.safetensors", depth_model(), partial(compare_depth, reference=reference)
    for name, (_, _, names) in VGGT.items():
        for case in names:
            yield Path(folder) / f"{name}.{case}.safetensors", aggregator(name), compare_aggregator


def goldens(folder):
    failed = 0
    for path, model, compared in cases(folder):
        golden = load_file(path)
        for dtype, limit in ((torch.float64, 1e-6), (torch.float32, TOLERANCE)):
            errors = compared(model.to(dtype), golden)
            # Short raw quaternions and clamped exponentials amplify errors.
            bad = {k: e for k, e in errors.items() if not e <= limit * (4 if k.endswith("gauss") else 1)}
            print(f"{path.name} {dtype}: {len(errors)} taps, worst {max(errors.values()):.1e}", bad or "")
            failed += len(bad)
    raise SystemExit(1 if failed else 0)


@torch.no_grad()
def dump(weights, out):
    """Writes two views and their Gaussians in f64, with and without priors.

    Also stores the deviation of the f32 forward pass by field, as a bound for the engine.
    """
    architecture, state, _ = load(weights)
    model = ZipSplat(architecture).eval()
    model.load_state_dict(state)
    in_f32 = copy.deepcopy(model)
    model.double()
    random = np.random.default_rng(1)
    side = 4 * architecture.patch
    y, x = np.mgrid[:side, :side] / side
    images = np.stack([np.stack([x, y, np.sin(9 * (x + y) + v)]) * 0.4 + 0.4 for v in range(2)])
    images = (255 * (images + 0.2 * random.random(images.shape))).astype(np.uint8)
    camera = torch.tensor([[side, side, 0.9 * side, 0.9 * side, side / 2, side / 2]]).expand(2, -1).float()
    pose = torch.tensor([[1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], [0.8, 0, -0.6, 0, 1, 0, 0.6, 0, 0.8, 0.5, 0, 0.1]])
    golden = {"in/images_u8": torch.from_numpy(images), "in/camera": camera.contiguous(), "in/pose": pose}
    views = (golden["in/images_u8"].float() / 255).double()[None]
    for case, priors in (("plain", None), ("priors", tuple(x.double() for x in priors_of(golden)))):
        layers, color = model.prepare(views, priors)
        layers_f32, color_f32 = in_f32.prepare(views.float(), priors and tuple(x.float() for x in priors))
        for ratio in (1.0, 0.5):
            taps = {}
            indices = None if ratio == 1 else nearest_tokens(layers[0], int(layers[0].shape[1] * ratio))
            gauss, _ = model.decode(layers, color, indices=indices, taps=taps)
            golden[f"{case}/r{ratio:g}/gauss"] = gauss[0].float()
            found, _ = in_f32.decode(layers_f32, color_f32, indices=indices, taps={})
            for field, (start, end) in FIELDS.items():
                in_field = deviation(found[0, :, start:end], gauss[0, :, start:end])
                golden[f"{case}/r{ratio:g}/f32_deviation/{field}"] = in_field.float()[None]
            if indices is not None:
                golden[f"{case}/r{ratio:g}/nearest_idx"] = indices[0]
    save_file({name: value.contiguous() for name, value in golden.items()}, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("goldens")
    command.add_argument("folder")
    command.set_defaults(run=lambda a: goldens(a.folder))
    command = commands.add_parser("dump")
    command.add_argument("weights")
    command.add_argument("out")
    command.set_defaults(run=lambda a: dump(a.weights, a.out))
    args = parser.parse_args()
    args.run(args)
