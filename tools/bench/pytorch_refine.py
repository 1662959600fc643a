"""Times refinement in PyTorch (tools/train/rasterize.py), for `zipsplat bench refine --pytorch`.

    pytorch_refine.py SCENE.ply WIDTH HEIGHT PHOTOS WARMUP REPEATS

Prints JSON: device, torch, and the milliseconds of each run of rendering alone and of a step
(rendering, 0.8 L1 + 0.2 (1 - SSIM), gradients, Adam). Without arguments it only checks its imports.
The cameras are those of `zipsplat bench refine`: near the origin, along z, each with a view as wide
as it is distant.
"""

import sys

try:
    import numpy  # noqa: F401
    import torch

    if not torch.cuda.is_available():
        import numba  # noqa: F401
except ImportError as error:
    sys.exit(f"{error.name} is not installed")
if len(sys.argv) == 1:
    sys.exit()

import torch.nn.functional as F

from rasterize import rasterize
from scene import read_ply
from timing import DEVICE, measure, report

path = sys.argv[1]
width, height, photos, warmup, repeats = map(int, sys.argv[2:7])
*values, degree = read_ply(path, DEVICE)
parameters = [value.contiguous().requires_grad_() for value in values]
rates = (5e-3, 0.1, 0.03, 0.2, 0.03)
adam = torch.optim.Adam([{"params": [p], "lr": rate} for p, rate in zip(parameters, rates)], eps=1e-15)

focal = float(max(width, height))
views = torch.eye(4, device=DEVICE).repeat(1, photos, 1, 1)
views[0, :, 0, 3] = -0.01 * torch.arange(photos, device=DEVICE)
intrinsics = torch.tensor([focal, focal, width / 2, height / 2], device=DEVICE).repeat(1, photos, 1)
targets = torch.rand(photos, 3, height, width, device=DEVICE)
taps = torch.exp(-((torch.arange(11, device=DEVICE) - 5.0) ** 2) / 4.5)
taps = (taps / taps.sum()).expand(3, 1, 1, 11)


def filtered(x):
    return F.conv2d(F.conv2d(x, taps, padding=(0, 5), groups=3), taps.mT, padding=(5, 0), groups=3)


def dssim(a, b):
    mean_a, mean_b = filtered(a), filtered(b)
    var_a, var_b = filtered(a * a) - mean_a**2, filtered(b * b) - mean_b**2
    covariance = filtered(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return 1 - (numerator / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean()


def pictures():
    means, scales, quats, opacities, sh = parameters
    packed = torch.cat([means, scales.exp(), quats, opacities.sigmoid(), sh.flatten(1)], 1)[None]
    return rasterize(packed, views, intrinsics, (height, width), degree).rgb[0].movedim(-1, 1)


@torch.no_grad()
def forward():
    pictures()


def step():
    drawn = pictures()
    loss = 0.8 * (drawn - targets).abs().mean() + 0.2 * dssim(drawn, targets)
    adam.zero_grad()
    loss.backward()
    adam.step()


forward(), step()  # compiles
works = {"picture": forward, "step": step}
report([{"what": what, "ms": measure(work, warmup, repeats)} for what, work in works.items()])
