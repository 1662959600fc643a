"""Training losses: pictures, geometry, bounds on Gaussians (ZipSplat, section 3.3, appendix A)."""

import math

import torch
import torch.nn.functional as F
from torch import nn

from initialize import SH0


def ssim(a, b):
    """Mean structural similarity of [N, 3, H, W] in 0..1, uniform 7 x 7 windows."""

    def mean(x):
        return F.avg_pool2d(F.avg_pool2d(x, (7, 1), 1), (1, 7), 1)

    mean_a, mean_b = mean(a), mean(b)
    unbias = 49 / 48
    var_a, var_b = (mean(x * x) - m * m for x, m in ((a, mean_a), (b, mean_b)))
    covariance = mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mean_a * mean_b + c1) * (2 * unbias * covariance + c2)
    return (numerator / ((mean_a**2 + mean_b**2 + c1) * (unbias * (var_a + var_b) + c2))).mean()


def gradient_difference(a, b, scales=3):
    """Mean absolute difference of image gradients of [N, 3, H, W] over halved resolutions."""
    total = 0
    for _ in range(scales):
        difference = a - b
        total = total + difference.diff(dim=-1).abs().mean() + difference.diff(dim=-2).abs().mean()
        a, b = F.avg_pool2d(a, 2), F.avg_pool2d(b, 2)
    return total / scales


class Lpips(nn.Module):
    """LPIPS 0.1 by VGG16 (Zhang et al. 2018), differentiable in the first picture."""

    CHANNELS = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
    # Convolutions after a pooling; features are compared before each and at the end.
    POOLED = (2, 4, 7, 10)
    SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

    def __init__(self, tensors):
        super().__init__()
        for name, value in tensors.items():
            value = value.movedim(-1, 1).contiguous() if name.endswith("weight") and value.ndim == 4 else value
            self.register_buffer(name.replace(".", "_"), value, persistent=False)
        for name in ("SHIFT", "SCALE"):
            self.register_buffer(name.lower(), torch.tensor(getattr(self, name))[:, None, None], persistent=False)

    @classmethod
    def shapes(cls):
        """Returns {name: shape} of the file by tools/lpips.py."""
        shapes = {}
        for i, (inputs, outputs) in enumerate(zip((3, *cls.CHANNELS), cls.CHANNELS)):
            shapes |= {f"convolutions.{i}.weight": (outputs, 3, 3, inputs), f"convolutions.{i}.bias": (outputs,)}
        return shapes | {f"taps.{tap}.weight": (cls.CHANNELS[i - 1],) for tap, i in enumerate((*cls.POOLED, 13))}

    def forward(self, a, b):
        """Mean distance of pairs of [N, 3, H, W], clipped to 0..1."""
        x = (2 * torch.cat((a, b)).clamp(0, 1) - 1 - self.shift) / self.scale
        distance = tap = 0
        for i in range(13):
            if i in self.POOLED:
                x = F.max_pool2d(x, 2)
            x = F.conv2d(x, getattr(self, f"convolutions_{i}_weight"), getattr(self, f"convolutions_{i}_bias"), padding=1).relu()
            if i + 1 in (*self.POOLED, 13):
                unit_a, unit_b = (x / (x.square().sum(1, keepdim=True).add(1e-20).sqrt() + 1e-10)).chunk(2)
                weights = getattr(self, f"taps_{tap}_weight")[:, None, None]
                distance = distance + ((unit_a - unit_b).square() * weights).sum(1).mean()
                tap += 1
        return distance


# Distances of the Chamfer search in memory, 256 MiB.
PAIRS = 1 << 26


def chamfer(means, points, free, sample=0, robust=False):
    """Mean squared distance of `free` [B, N] Gaussians to their nearest point.

    `sample` > 0 reads that many random Gaussians. `robust` is linear beyond distance 1, so outliers
    do not dominate.
    """
    b, n = means.shape[:2]
    if 0 < sample < n:
        index = torch.randint(n, (b, sample), device=means.device)
        means = means.gather(1, index[..., None].expand(-1, -1, 3))
        free = free.gather(1, index)
    with torch.no_grad():
        square, transposed = points.square().sum(-1)[:, None], points.transpose(1, 2)
        parts = means.split(max(PAIRS // (b * points.shape[1]), 1), 1)
        nearest = torch.cat([(square - 2 * part @ transposed).argmin(2) for part in parts], 1)
    square = (means - points.gather(1, nearest[..., None].expand(-1, -1, 3))).square().sum(-1)
    if robust:
        distance = square.add(1e-8).sqrt()
        square = F.smooth_l1_loss(distance, torch.zeros_like(distance), reduction="none")
    return (square * free).mean()


def depth(pictures, truth, robust=False):
    """L1 between rendered and true depth [B, C, H, W] where it is known (above 0).

    As the reference code, rendered depth is accumulated, and the mean is of known pixels. `robust`
    is relative to depth, and accumulates weight * (depth - truth): its gradients reach depth, and
    weight at wrong depth.
    """
    known = truth > 0
    if robust:
        return ((pictures.depth - pictures.alpha * truth).abs() / truth.clamp_min(0.5) * known).mean()
    return ((pictures.depth - truth).abs() * known).sum() / known.sum().clamp_min(1)


def signed_log(x):
    """Inverse of the head's activation of means: weighs near and far errors alike."""
    return x.sign() * torch.log1p(x.abs())


def of_tokens(values, tokens):
    """Gathers [B, V * T, ...] at the kept tokens [B, K]; None keeps all."""
    if tokens is None:
        return values
    return values.gather(1, tokens.view(*tokens.shape, *[1] * (values.ndim - 2)).expand(-1, -1, *values.shape[2:]))


def middles(values, tokens, cells):
    """Means [B, tokens, cells, 3] of [B, N, 3], whose consecutive Gaussians share a cell."""
    return values.unflatten(1, (tokens, cells, -1)).mean(3)


def anchor(means, anchors, tokens):
    """Distance of a token's Gaussians to the surface in its patch's cells, on the head's scale.

    `anchors` [B, V * T, rows, columns, 3]; G / cells consecutive Gaussians share a cell. Not in the
    paper, whose backbone is pretrained: from scratch, tokens merge into one opaque cloud. The
    weight fades out during training.
    """
    anchors = of_tokens(anchors, tokens).flatten(2, 3)
    return F.smooth_l1_loss(middles(signed_log(means), *anchors.shape[1:3]), signed_log(anchors), beta=0.1)


def color(constants, batch, tokens):
    """L1 between Gaussians' constant colors and their cells' means, for steps without rendering."""
    patches, cells = batch.anchors.shape[1], batch.anchors.shape[2:4]
    views, height, width = batch.images.shape[1], *batch.images.shape[-2:]
    patch = math.isqrt(height * width * views // patches)
    squares = batch.images.unfold(3, patch, patch).unfold(4, patch, patch)  # [B, V, 3, rows, columns, patch, patch]
    means = F.adaptive_avg_pool2d(squares.flatten(0, 4), cells).view(*squares.shape[:5], math.prod(cells))
    means = of_tokens(means.permute(0, 1, 3, 4, 5, 2).flatten(1, 3), tokens)
    return (0.5 + SH0 * middles(constants, *means.shape[1:3]) - means).abs().mean()


def ray(means, batch, given, tokens):
    """Distance of Gaussians to the rays of their cells, relative to depth, for `given` cameras.

    Cameras determine rays exactly, but pictures determine depth only coarsely.
    """
    patches = batch.anchors.shape[1] // batch.poses.shape[1]
    eyes = batch.poses[..., :3, 3].repeat_interleave(patches, 1)[:, :, None]
    anchors, eyes = (of_tokens(x, tokens) for x in (batch.anchors.flatten(2, 3), eyes))
    towards = anchors - eyes
    distance = towards.norm(dim=-1, keepdim=True).clamp_min(0.05)
    direction = towards / distance
    offset = (middles(means, *anchors.shape[1:3]) - eyes) / distance
    beside = offset - (offset * direction).sum(-1, keepdim=True) * direction
    beside = beside.square().sum(-1).add(1e-8).sqrt()
    error = F.smooth_l1_loss(beside, torch.zeros_like(beside), reduction="none", beta=0.02)
    return (error.mean((1, 2)) * given).mean()


def total(gaussians, tokens, pictures, given, batch, weights, config, perceptual=None):
    """Returns the weighted sum and the losses by name.

    `tokens` are the kept ones, `pictures` None skips rendering losses, `given` [B] marks scenes
    with known cameras.
    """
    means, scales, opacity = gaussians[..., :3], gaussians[..., 3:6], gaussians[..., 10]
    parts = {"position": F.relu(torch.log1p(means.abs()) - 3).square().mean()}
    # Learned queries have no patches.
    if weights["anchor"]:
        parts["anchor"] = anchor(means, batch.anchors, tokens)
    if weights["ray"]:
        parts["ray"] = ray(means, batch, given, tokens)
    if pictures is None:
        parts["color"] = color(gaussians[..., 11:14], batch, tokens)
    else:
        parts |= seen(means, pictures, batch, weights, config, perceptual)
        hinges = config["hinges"]
        parts["scale"] = F.relu(scales - hinges["scale"]).square().mean()
        parts["far"] = F.relu(means.abs() - hinges["far"]).square().mean()
        # The reference code penalizes opacities below the hinge; the paper's text, those above.
        parts["faint"] = F.relu(hinges["opacity"] - opacity).square().mean()
        parts["opacity"] = F.relu(opacity - hinges["opacity"]).square().mean()
    parts = {name: value for name, value in parts.items() if weights[name]}
    return sum(weights[name] * value for name, value in parts.items()), parts


def seen(means, pictures, batch, weights, config, perceptual):
    """Returns the losses that need rendered targets."""
    rgb, truth = (x.flatten(0, 1).movedim(-1, 1) for x in (pictures.rgb, batch.colors))
    parts = {
        "l1": (rgb - truth).abs().mean(),
        "mse": (rgb - truth).square().mean(),
        "depth": depth(pictures, batch.depth, config["robust"]),
    }
    if weights["chamfer"]:
        parts["chamfer"] = chamfer(means, batch.points, ~pictures.reached, config["chamfer_gaussians"], config["robust"])
    if perceptual is not None and weights["perceptual"]:
        parts["perceptual"] = perceptual(rgb, truth)
    elif weights["ssim"] or weights["gradient"]:
        parts["ssim"] = 1 - ssim(rgb, truth)
        parts["gradient"] = gradient_difference(rgb, truth)
    return parts
