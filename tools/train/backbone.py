"""A backbone to start from: one that this project trained, or Depth Anything 3's as it is released."""

import torch
from safetensors import safe_open

from weights import ARCHITECTURE_KEY

# Names in a release (model.safetensors of da3-small, da3-base, da3-large, da3-giant), and ours.
RELEASED = {"model.backbone.pretrained.": "backbone.backbone.", "model.cam_enc.": "backbone.cam_enc."}

# Releases see pictures in this range, ZipSplat in 0..1.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def read(path):
    """{name: f32 tensor} of the backbone and its camera encoder in a file of weights."""
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
    if released:
        take_in_range(found)
    return found


def take_in_range(tensors):
    """Lets the patches' convolution read 0..1 where it read (x - MEAN) / DEVIATION."""
    weight, bias = (tensors[f"backbone.backbone.patch_embed.proj.{part}"] for part in ("weight", "bias"))
    weight /= weight.new_tensor(DEVIATION)[:, None, None]
    bias -= torch.einsum("ocyx,c->o", weight, weight.new_tensor(MEAN))


@torch.no_grad()
def take_over(model, path):
    """Gives a model the backbone and the camera encoder of a file; the rest stays as it is."""
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
