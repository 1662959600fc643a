"""A network with a grown color branch gives the same output but for the added color detail.

python tests/train/growing.py WEIGHTS
"""

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools" / "train"))

import torch

from grow import refine, widen_colors
from model import ZipSplat
from weights import load

torch.manual_seed(0)
coarse, tensors, _ = load(sys.argv[1])
tensors = refine(tensors, coarse, 36)
before = replace(coarse, gaussians_per_token=36)
after = replace(before, color_width=2 * before.color_width, color_heads=2 * before.color_heads,
                color_hidden=2 * before.color_hidden, head_hidden=before.head_hidden + 2 * 36)  # fmt: skip
small, large = ZipSplat(before), ZipSplat(after)
small.load_state_dict(tensors)
large.load_state_dict(widen_colors(tensors, large, (6, 6)))

noise = torch.rand(1, 2, 3, 6 * before.patch, 6 * before.patch)
for name, pictures in (("flat", torch.full_like(noise, 0.5)), ("detailed", noise)):
    with torch.no_grad():
        old, new = (model(pictures)[0] for model in (small, large))
    change = (new - old).abs()
    colors, rest = change[..., 11:14].max(), torch.cat((change[..., :11], change[..., 14:]), -1).max()
    print(f"{name}: changes of {colors:.4f} in constant colors, {rest:.4f} in all else")
    assert rest < 0.05, "expected none but for what detail does to a norm"
    assert colors < 1e-3 if name == "flat" else colors > 0.1, "expected the detail of a picture and nothing else"
