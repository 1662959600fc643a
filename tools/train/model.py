"""The ZipSplat network over a batch of scenes, with the parameter names of the engine's files.

Shapes: B scenes, V views, T patches a view, n = T + 1 tokens a view, D width, K scene tokens,
G Gaussians a token.
"""

from functools import cache

import torch
import torch.nn.functional as F
from torch import nn

from layers import Block, CrossBlock, Mlp, PatchEmbed, Recomputed, SwiGlu, resampled, rope_table
from vggt import Aggregator

BACKBONE_EPS = 1e-6


class VisionTransformer(nn.Module):
    def __init__(self, a):
        super().__init__()
        self.architecture = a
        self.cls_token = nn.Parameter(torch.zeros(1, 1, a.width))
        self.camera_token = nn.Parameter(torch.zeros(1, 2, a.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + a.position_grid**2, a.width))
        self.patch_embed = PatchEmbed(a.width, a.patch)
        self.blocks = nn.ModuleList(
            Block(
                a.width,
                a.heads,
                Mlp(a.width, a.ffn_hidden, a.width) if a.ffn == "gelu" else SwiGlu(a.width, a.ffn_hidden),
                qk_norm=i >= a.qk_norm_start,
                eps=BACKBONE_EPS,
            )
            for i in range(a.depth)
        )
        self.norm = nn.LayerNorm(a.width, BACKBONE_EPS)

    def forward(self, images, camera_tokens, taps):
        """[B, V, 3, H, W] -> for each of `out_layers`: (local, global) patch tokens [B, V, T, D].

        `camera_tokens` [B, V, D], or None for the learned ones.
        """
        a = self.architecture
        b, v = images.shape[:2]
        rows, columns = (side // a.patch for side in images.shape[-2:])
        positions = resampled(self.pos_embed[:, 1:], rows, columns, cubic_weights)
        patches = self.patch_embed(images.flatten(0, 1)) + positions
        cls = (self.cls_token + self.pos_embed[:, :1]).expand(b * v, -1, -1)
        x = torch.cat((cls, patches), 1).unflatten(0, (b, v))
        if camera_tokens is None:
            camera_tokens = self.learned_camera_tokens(b, v)
        table = (a.width // a.heads, x.dtype, x.device)
        ropes = {is_global: rope_table(rows, columns, v if is_global else 0, *table) for is_global in (False, True)}
        taps["bb/tokens0"] = x
        taps["bb/cam_token"] = camera_tokens
        features, local = [], None
        for i, block in enumerate(self.blocks):
            if i == a.alt_start:
                x = taps["bb/alt_in"] = torch.cat((camera_tokens[:, :, None].to(x.dtype), x[:, :, 1:]), 2)
            is_global = a.is_global(i)
            tokens = x.flatten(1, 2) if is_global else x.flatten(0, 1)
            x = block(tokens, ropes[is_global] if i >= a.rope_start else None).view(x.shape)
            taps[f"bb/block{i}"] = x
            local = local if is_global else x
            if i in a.out_layers:
                features.append((local[:, :, 1:], self.norm(x)[:, :, 1:]))
        return features

    def learned_camera_tokens(self, scenes, views):
        first, others = self.camera_token[:, :1], self.camera_token[:, 1:]
        return torch.cat((first, others.expand(-1, views - 1, -1)), 1).expand(scenes, -1, -1)


@cache
def cubic_weights(size, grid, dtype, device):
    """[size, grid] weights of cubic convolution (A = -0.75), with the reference's +0.1 on the size."""
    a = -0.75
    source = (torch.arange(size, dtype=torch.float64) + 0.5) / ((size + 0.1) / grid) - 0.5
    base = source.floor()
    weights = torch.zeros(size, grid, dtype=torch.float64)
    for tap in range(-1, 3):
        u = (source - base - tap).abs()
        near = ((a + 2) * u - (a + 3)) * u * u + 1
        far = ((a * u - 5 * a) * u + 8 * a) * u - 4 * a
        index = (base + tap).clamp(0, grid - 1).long()
        weights.scatter_add_(1, index[:, None], torch.where(u <= 1, near, far)[:, None])
    return weights.to(device, dtype)


def quats_from_matrices(m):
    """[..., 3, 3] rotations to xyzw quaternions, w >= 0; divides by the largest component."""
    diagonal = m.diagonal(dim1=-2, dim2=-1)
    signs = m.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    size = (1 + diagonal @ signs.T).clamp_min(0).sqrt()  # twice |w|, |x|, |y|, |z|
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in m.unbind(-2))
    w, x, y, z = (size**2).unbind(-1)
    candidates = torch.stack(
        [
            torch.stack((zy - yz, xz - zx, yx - xy, w), -1),
            torch.stack((x, xy + yx, xz + zx, zy - yz), -1),
            torch.stack((xy + yx, y, yz + zy, xz - zx), -1),
            torch.stack((xz + zx, yz + zy, z, yx - xy), -1),
        ],
        -2,
    ) / (2 * size[..., None]).clamp_min(0.2)
    best = size.argmax(-1)[..., None, None].expand(*size.shape[:-1], 1, 4)
    quats = candidates.gather(-2, best)[..., 0, :]
    return torch.where(quats[..., 3:] < 0, -quats, quats)


class CameraEncoder(nn.Module):
    def __init__(self, a):
        super().__init__()
        hidden = a.camera_hidden
        self.trunk = nn.ModuleList(
            Block(a.width, a.camera_heads, Mlp(a.width, hidden, a.width), qk_norm=False) for _ in range(a.camera_depth)
        )
        self.token_norm = nn.LayerNorm(a.width)
        self.trunk_norm = nn.LayerNorm(a.width)
        self.pose_branch = Mlp(9, a.camera_pose_hidden, a.width)

    def forward(self, poses, intrinsics, size):
        """Poses [B, V, 4, 4] camera to world, [B, V, 4] fx, fy, cx, cy, (H, W) -> [B, V, D]."""
        rotation = poses[..., :3, :3].transpose(-1, -2)
        translation = -(rotation @ poses[..., :3, 3:])[..., 0]
        height, width = size
        fov = 2 * torch.atan(intrinsics.new_tensor([height, width]) / (2 * intrinsics[..., [1, 0]]))
        x = self.token_norm(self.pose_branch(torch.cat((translation, quats_from_matrices(rotation), fov), -1)))
        for block in self.trunk:
            x = block(x)
        return self.trunk_norm(x)


class Backbone(nn.Module):
    """Features of either family, under the released parameter names."""

    def __init__(self, a):
        super().__init__()
        if a.family == "vggt":
            self.aggregator = Aggregator(a)
        else:
            self.backbone = VisionTransformer(a)
            self.cam_enc = CameraEncoder(a)

    def embedding(self):
        """Returns the module with the patch embedding and its positions."""
        return self.backbone if hasattr(self, "backbone") else self.aggregator.patch_embed

    def forward(self, images, priors, given, taps):
        """Returns (local, global) patch tokens [B, V, T, D] by layer; VGGT ignores priors."""
        if hasattr(self, "aggregator"):
            return self.aggregator(images, taps)
        vit, camera_tokens = self.backbone, None
        if priors is not None:
            # In bf16, rotations would deviate by up to 0.3 degrees.
            with torch.autocast(images.device.type, enabled=False):
                camera_tokens = self.cam_enc(*priors, images.shape[-2:])
            if given is not None:
                learned = vit.learned_camera_tokens(*images.shape[:2])
                camera_tokens = torch.where(given[:, None, None], camera_tokens.to(learned.dtype), learned)
        return vit(images, camera_tokens, taps)


class GaussianHead(nn.Module):
    def __init__(self, a):
        super().__init__()
        inputs = a.width + a.color_width
        outputs = a.gaussians_per_token * a.gaussian_width
        self.gaussian_head = nn.Sequential(Mlp(inputs, a.head_hidden, inputs), nn.Linear(inputs, outputs))

    def forward(self, x):
        return self.gaussian_head(x)


@cache
def first_tokens(n, count, device):
    """Evenly spaced indices; on the CPU in f32, whose rounding is part of the definition."""
    return torch.linspace(0, n - 1, count).round().long().to(device)


@torch.no_grad()
def nearest_tokens(tokens, count, iterations=5):
    """k-means over [B, N, D]: indices [B, count] of the tokens nearest to the centroids."""
    tokens = tokens.float()
    n = tokens.shape[1]
    clusters = torch.arange(count, device=tokens.device)
    centroids = tokens[:, first_tokens(n, count, tokens.device)]
    # bf16 products would change a third of the choices.
    with torch.autocast(tokens.device.type, enabled=False):
        for _ in range(iterations):
            assigned = (squared_distances(tokens, centroids).argmin(-1, keepdim=True) == clusters).to(tokens)
            members = assigned.sum(1)[..., None]
            centroids = (assigned.transpose(1, 2) @ tokens) / members.clamp_min(1)
        return squared_distances(centroids, tokens).argmin(-1)


def squared_distances(a, b):
    """[B, N, M] of [B, N, D] and [B, M, D] without |a|^2, which does not affect the nearest."""
    return (b * b).sum(-1)[:, None] - 2 * (a @ b.transpose(1, 2))


def activate(raw, sh_degree):
    """[..., 11 + 3K] -> means 3, scales 3, unit quats 4 (wxyz), opacity 1, SH K x 3."""
    means, scales, quats, opacity, sh = raw.split((3, 3, 4, 1, 3 * (sh_degree + 1) ** 2), -1)
    means = means.clamp(-5, 5)
    means = means.sign() * torch.expm1(means.abs())
    scales = F.softplus(scales - 4).clamp(1e-6, 15)
    quats = quats / quats.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.cat((means, scales, quats, opacity.sigmoid(), sh), -1)


class ZipSplat(nn.Module):
    """The network. `queries` > 0 uses learned queries instead of scene tokens, as C3G (2025) does.

    Learned queries are for comparison in training; the engine does not support them. `recompute`
    trades the blocks' activations for a second forward pass.
    """

    def __init__(self, architecture, queries=0, recompute=False):
        super().__init__()
        a = self.architecture = architecture
        layers = range(len(a.out_layers))
        self.backbone = Backbone(a)
        self.pre_norm_local = nn.ModuleList(nn.LayerNorm(a.width) for _ in layers)
        self.pre_norm_global = nn.ModuleList(nn.LayerNorm(a.width) for _ in layers)
        self.downscale = nn.ModuleList(nn.Linear(2 * a.width, a.width) for _ in layers)
        self.cross_attention = nn.ModuleList(CrossBlock(a.width, a.fusion_heads, a.fusion_hidden) for _ in layers)
        self.self_attention = nn.ModuleList(
            Block(a.width, a.fusion_heads, Mlp(a.width, a.fusion_hidden, a.width), qk_norm=True) for _ in layers
        )
        self.color_embed = PatchEmbed(a.color_width, a.patch)
        self.color_cross_attention = CrossBlock(a.color_width, a.color_heads, a.color_hidden)
        self.gaussian_head = GaussianHead(a)
        self.queries, self.color_queries = (
            nn.Parameter(torch.zeros(1, queries, width)) if queries else None for width in (a.width, a.color_width)
        )
        for module in self.modules():
            if isinstance(module, Recomputed):
                module.recompute = recompute

    def prepare(self, images, priors=None, given=None, taps=None):
        """[B, V, 3, H, W] in 0..1 -> layer tokens [B, V * T, D], deepest first, and color tokens.

        `priors` is (poses [B, V, 4, 4] camera to world, intrinsics [B, V, 4] fx, fy, cx, cy in
        pixels) or None; `given` [B] selects the scenes that use them (None: all).
        """
        taps = {} if taps is None else taps
        layers = []
        for i, (local, global_) in enumerate(reversed(self.backbone(images, priors, given, taps))):
            taps[f"bb/feat{i}"] = torch.cat((local, global_), -1)
            local, global_ = self.pre_norm_local[i](local), self.pre_norm_global[i](global_)
            tokens = self.downscale[i](torch.cat((local, global_), -1)) + (local + global_) / 2
            taps[f"prep/layer{i}"] = tokens
            layers.append(tokens.flatten(1, 2))
        color = self.color_embed(images.flatten(0, 1)).unflatten(0, images.shape[:2]).flatten(1, 2)
        taps["color/tokens"] = color
        return layers, color

    def decode(self, layers, color, ratio=1.0, indices=None, taps=None):
        """Returns packed Gaussians [B, K * G, 11 + 3K'] and their token indices [B, K].

        `indices` [B, K] override clustering. Returned indices are None for all tokens or queries.
        """
        taps = {} if taps is None else taps
        if self.queries is not None:
            scene, queries = (q.expand(len(color), -1, -1) for q in (self.queries, self.color_queries))
            for cross, own, tokens in zip(self.cross_attention, self.self_attention, layers):
                scene = own(scene + cross(scene, tokens))
            return self.gaussians(scene, queries + self.color_cross_attention(queries, color), taps), None
        count = max(1, int(layers[0].shape[1] * ratio))
        if indices is None and count < layers[0].shape[1]:
            indices = nearest_tokens(layers[0], count)

        def chosen(tokens):
            return tokens if indices is None else tokens.gather(1, indices[..., None].expand(-1, -1, tokens.shape[-1]))

        scene = taps["scene_init"] = chosen(layers[0])
        for i, tokens in enumerate(layers):
            delta = taps[f"ca{i}_delta"] = self.cross_attention[i](chosen(tokens), tokens)
            scene = taps[f"scene_ca{i}"] = scene + delta
            scene = taps[f"scene_sa{i}"] = self.self_attention[i](scene)
        queries = chosen(color)
        color = taps["color_feats"] = queries + self.color_cross_attention(queries, color)
        return self.gaussians(scene, color, taps), indices

    def gaussians(self, scene, color, taps):
        """Scene tokens [B, K, D], colors [B, K, Dc] -> packed Gaussians [B, K * G, 11 + 3K']."""
        with torch.autocast(scene.device.type, enabled=False):
            raw = taps["raw"] = self.gaussian_head(torch.cat((scene, color), -1).to(self.color_embed.proj.weight.dtype))
            packed = raw.unflatten(-1, (-1, self.architecture.gaussian_width)).flatten(1, 2)
            return activate(packed, self.architecture.sh_degree)

    def forward(self, images, ratio=1.0, priors=None, given=None):
        """[B, V, 3, H, W] in 0..1 -> packed Gaussians in the frame of view 0, token indices."""
        return self.decode(*self.prepare(images, priors, given), ratio)
