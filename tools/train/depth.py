"""Depth Anything 3 (small to giant) as a reference, with the parameter names of its releases.

Shapes: V views, T patches a view, D width, F features; gh x gw patches, H x W pixels of a view.
"""

import json
from types import SimpleNamespace

import torch
import torch.nn.functional as F
from torch import nn

from model import VisionTransformer

EPS = 1e-5
HIDDEN = 32
# Amplitude and frequency base of the positional encoding.
SHARE, BASE = 0.1, 100.0


class Backbone(nn.Module):
    """Holds submodules under the releases' parameter names."""

    def __init__(self, a):
        super().__init__()
        self.pretrained = VisionTransformer(a)
        self.pretrained.norm.eps = EPS


class Residual(nn.Module):
    def __init__(self, f):
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(f, f, 3, padding=1) for _ in range(2))

    def forward(self, x):
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    def __init__(self, f, deepest):
        super().__init__()
        if not deepest:
            self.resConfUnit1 = Residual(f)
        self.resConfUnit2 = Residual(f)
        self.out_conv = nn.Conv2d(f, f, 1)

    def forward(self, level, below, size):
        x = level if below is None else below + self.resConfUnit1(level)
        # Commutes with the resize and costs a quarter before it.
        return resized(self.out_conv(self.resConfUnit2(x)), size)


class ChannelNorm(nn.LayerNorm):
    """Normalizes the channels of [V, C, h, w]."""

    def forward(self, x):
        return super().forward(x.movedim(1, -1)).movedim(-1, 1)


def resized(x, size):
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


def placed(x, aspect):
    """Adds positions to [V, C, h, w], in a rectangle of this aspect with half diagonal 1."""
    channels, h, w = x.shape[1:]
    diagonal = (aspect**2 + 1) ** 0.5
    frequency = BASE ** (-torch.arange(channels // 4, dtype=torch.float64) / (channels // 4))

    def axis(count, half):
        place = half * (2 * torch.arange(count, dtype=torch.float64) + 1 - count) / count
        angles = frequency[:, None] * place
        return SHARE * torch.cat((angles.sin(), angles.cos()))

    across, down = axis(w, aspect / diagonal)[:, None], axis(h, 1 / diagonal)[:, :, None]
    table = torch.cat((across.expand(-1, h, w), down.expand(-1, h, w)))
    return x + table.to(x)


def convolutions(*channels):
    """A chain of 3 x 3 convolutions."""
    return nn.Sequential(*(nn.Conv2d(i, o, 3, padding=1) for i, o in zip(channels, channels[1:])))


class Head(nn.Module):
    """Depth, rays and their confidences, view by view."""

    def __init__(self, a):
        super().__init__()
        f, channels, width = a.features, a.channels, 2 * a.backbone.width
        self.norm = nn.LayerNorm(width, EPS)
        self.projects = nn.ModuleList(nn.Conv2d(width, c, 1) for c in channels)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(channels[0], channels[0], 4, 4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, 2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, 2, 1),
            )
        )
        parts = {f"layer{j + 1}_rn": nn.Conv2d(c, f, 3, padding=1, bias=False) for j, c in enumerate(channels)}
        for suffix in ("", "_aux"):
            parts |= {f"refinenet{j + 1}{suffix}": Fusion(f, j == 3) for j in range(4)}
        parts["output_conv1"] = nn.Conv2d(f, f // 2, 3, padding=1)
        parts["output_conv2"] = nn.Sequential(
            nn.Conv2d(f // 2, HIDDEN, 3, padding=1), nn.ReLU(), nn.Conv2d(HIDDEN, 2, 1)
        )
        # Files store one norm for all four ray heads.
        rays = {"0": nn.Conv2d(f // 2, HIDDEN, 3, padding=1), "5": nn.Conv2d(HIDDEN, 7, 1)}
        parts["output_conv1_aux"] = nn.ModuleDict({"3": convolutions(f, f // 2, f, f // 2, f, f // 2)})
        parts["output_conv2_aux"] = nn.ModuleDict(
            {"0": nn.ModuleDict({"2": ChannelNorm(HIDDEN, EPS)}), "3": nn.ModuleDict(rays)}
        )
        self.scratch = nn.ModuleDict(parts)

    def forward(self, features, size, patch):
        """Features [V, T, 2D], shallowest first, to logits.

        Depth [V, 2, H, W], rays [V, 7, 8gh, 8gw].
        """
        rows, columns = (side // patch for side in size)
        aspect = size[1] / size[0]
        levels = []
        for j, feature in enumerate(features):
            x = self.norm(feature).transpose(1, 2).unflatten(2, (rows, columns))
            x = self.resize_layers[j](placed(self.projects[j](x), aspect))
            levels.append(self.scratch[f"layer{j + 1}_rn"](x))
        depth = resized(self.scratch["output_conv1"](self.fused(levels, "")), size)
        depth = self.scratch["output_conv2"](placed(depth, aspect))
        rays = placed(self.scratch["output_conv1_aux"]["3"](self.fused(levels, "_aux")), aspect)
        tail = self.scratch["output_conv2_aux"]
        rays = tail["3"]["5"](F.relu(tail["0"]["2"](tail["3"]["0"](rays))))
        return depth, rays

    def fused(self, levels, suffix):
        below = None
        for j in (3, 2, 1, 0):
            size = levels[j - 1].shape[-2:] if j else [2 * side for side in levels[0].shape[-2:]]
            below = self.scratch[f"refinenet{j + 1}{suffix}"](levels[j], below, size)
        return below


class CameraDecoder(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.backbone = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t, self.fc_qvec = nn.Linear(width, 3), nn.Linear(width, 4)
        self.fc_fov = nn.Sequential(nn.Linear(width, 2), nn.ReLU())

    def forward(self, tokens):
        """[V, 2D] -> center, quaternion xyzw and fields of view [V, 9]."""
        x = self.backbone(tokens)
        return torch.cat((self.fc_t(x), self.fc_qvec(x), self.fc_fov(x)), -1)


class DepthAnything3(nn.Module):
    def __init__(self, architecture):
        super().__init__()
        a = self.architecture = architecture
        self.backbone = Backbone(a.backbone)
        self.head = Head(a)
        self.cam_dec = CameraDecoder(2 * a.backbone.width)

    def features(self, images, reference=0):
        """Normalized [V, 3, H, W] -> four features [V, T, 2D] and camera tokens [V, 2D].

        Features are sorted shallowest first. `reference` is the index of the reference view.
        """
        vit, taps = self.backbone.pretrained, {}
        a = vit.architecture
        order = [reference, *(view for view in range(len(images)) if view != reference)]
        back = torch.tensor(order).argsort().to(images.device)
        pairs = vit(images[order][None], None, taps)
        features = [torch.cat(pair, -1)[0, back] for pair in pairs]
        last = a.out_layers[-1]
        local = next(block for block in range(last, -1, -1) if not a.is_global(block))
        tokens = torch.cat([taps[f"bb/block{block}"][0, :, 0] for block in (local, last)], -1)
        return features, tokens[back]

    def heads(self, features, tokens, size, at_once=8):
        """Returns logits of depth and rays, `at_once` views per batch, and cameras."""
        parts = zip(*(feature.split(at_once) for feature in features))
        found = [self.head(part, size, self.architecture.backbone.patch) for part in parts]
        depth, rays = (torch.cat(parts) for parts in zip(*found))
        return depth, rays, self.cam_dec(tokens)


def architecture_from_json(text):
    """Parses the engine's `zipsplat::weights::DepthArchitecture`."""
    a = json.loads(text, object_hook=lambda fields: SimpleNamespace(**fields))
    alt_start = a.backbone.alt_start
    a.backbone.is_global = lambda block: block >= alt_start and block % 2 == 1
    return a
