"""Initial backbones: trained by this project or released by Depth Anything 3 or VGGT."""

import torch
from safetensors import safe_open

from vggt import DEVIATION, MEAN
from weights import ARCHITECTURE_KEY

# Name prefixes in releases (model.safetensors of da3-small to da3-giant, and of VGGT) and in our
# files.
RELEASED = {"model.backbone.pretrained.": "backbone.backbone.", "model.cam_enc.": "backbone.cam_enc.", "aggregator.": "backbone.aggregator."}
UNUSED = "backbone.aggregator.patch_embed.mask_token"


def read(path):
    """Returns {name: f32 tensor} of a file's backbone and camera encoder."""
    with safe_open(path, "pt") as file:
        names = list(file.keys())
        released = ARCHITECTURE_KEY not in (file.metadata() or {})
        prefixes = RELEASED if released else {name: name for name in RELEASED.values()}
        found = {
            ours + name.removeprefix(theirs): file.get_tensor(name).float()
            for theirs, ours in prefixes.items()
            for name in names
            if name.startswith(theirs)
        }
    if not found:
        raise SystemExit(f"{path}: found no backbone, expected tensors {' or '.join(prefixes)}*")
    found.pop(UNUSED, None)
    if released and "backbone.backbone.cls_token" in found:
        take_in_range(found)
    return found


def take_in_range(tensors):
    """Folds Depth Anything 3's input normalization into the patch embedding: ours reads 0..1."""
    weight, bias = (tensors[f"backbone.backbone.patch_embed.proj.{part}"] for part in ("weight", "bias"))
    weight /= weight.new_tensor(DEVIATION)[:, None, None]
    bias -= torch.einsum("ocyx,c->o", weight, weight.new_tensor(MEAN))


@torch.no_grad()
def take_over(model, path):
    """Copies backbone and camera encoder of a file into a model."""
    found, own = read(path), {name: p for name, p in model.named_parameters() if name.startswith("backbone.")}
    wrong = [f"{name} is missing" for name in own.keys() - found.keys()]
    wrong += [f"{name} is unexpected" for name in found.keys() - own.keys()]
    wrong += [
        f"{name} is {list(found[name].shape)}, expected {list(p.shape)}"
        for name, p in own.items()
        if name in found and found[name].shape != p.shape
    ]
    if wrong:
        more = f" and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise SystemExit(f"{path}: found another backbone than the configuration's: {'; '.join(sorted(wrong)[:5])}{more}")
    for name, p in own.items():
        p.copy_(found[name])
