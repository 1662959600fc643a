"""VGGT's backbone: DINOv2 with registers, then pairs of blocks within and across views.

Shapes: B scenes, V views, T patches a view, P = 5 + T tokens a view, D width.
"""

from functools import cache

import torch
from torch import nn

from layers import Block, Mlp, PatchEmbed, resampled, rope_table

REGISTERS = 4
EMBEDDING_EPS, EPS = 1e-6, 1e-5
# Pictures are normalized with these.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def blocks(a, count, qk_norm, eps):
    return nn.ModuleList(Block(a.width, a.heads, Mlp(a.width, a.ffn_hidden, a.width), qk_norm, eps) for _ in range(count))


class Embedding(nn.Module):
    """DINOv2: each view alone."""

    def __init__(self, a):
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, a.width))
        self.register_tokens = nn.Parameter(torch.zeros(1, REGISTERS, a.width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + a.position_grid**2, a.width))
        self.patch_embed = PatchEmbed(a.width, a.patch)
        self.blocks = blocks(a, a.alt_start, False, EMBEDDING_EPS)
        self.norm = nn.LayerNorm(a.width, EMBEDDING_EPS)

    def forward(self, images, rows, columns, taps):
        """Normalized [N, 3, H, W] -> patch tokens [N, T, D]"""
        patches = self.patch_embed(images) + resampled(self.pos_embed[:, 1:], rows, columns, cubic_weights)
        special = torch.cat((self.cls_token + self.pos_embed[:, :1], self.register_tokens), 1)
        x = taps["pe/tokens0"] = torch.cat((special.expand(len(images), -1, -1), patches), 1)
        for i, block in enumerate(self.blocks):
            x = taps[f"pe/block{i}"] = block(x)
        x = taps["pe/out"] = self.norm(x)[:, 1 + REGISTERS :]
        return x


class Aggregator(nn.Module):
    """`alt_start` blocks of the embedding, then pairs; `out_layers` end pairs."""

    def __init__(self, a):
        super().__init__()
        self.architecture = a
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, a.width))
        self.register_token = nn.Parameter(torch.zeros(1, 2, REGISTERS, a.width))
        self.patch_embed = Embedding(a)
        pairs = (a.depth - a.alt_start) // 2
        self.frame_blocks, self.global_blocks = (blocks(a, pairs, True, EPS) for _ in range(2))

    def forward(self, images, taps):
        """[B, V, 3, H, W] in 0..1 -> (local, global) patch tokens [B, V, T, D] of `out_layers`."""
        a = self.architecture
        b, v = images.shape[:2]
        rows, columns = (side // a.patch for side in images.shape[-2:])
        mean, deviation = (images.new_tensor(values)[:, None, None] for values in (MEAN, DEVIATION))
        patches = self.patch_embed(((images - mean) / deviation).flatten(0, 1), rows, columns, taps).unflatten(0, (b, v))
        first, others = torch.cat((self.camera_token, self.register_token), 2).unbind(1)
        special = torch.cat((first, others.expand(v - 1, -1, -1))).expand(b, -1, -1, -1)
        x = taps["agg/tokens0"] = torch.cat((special.to(patches.dtype), patches), 2)
        # Special tokens share the camera token's position; views share all positions.
        table = rope_table(rows, columns, 0, a.width // a.heads, x.dtype, x.device)
        local = [torch.cat((angles[:1].expand(REGISTERS, -1), angles)) for angles in table]
        joint = [angles.repeat(v, 1) for angles in local]
        features = []
        for i, (frame, across) in enumerate(zip(self.frame_blocks, self.global_blocks)):
            x = within = taps[f"agg/frame{i}"] = frame(x.flatten(0, 1), local).view(x.shape)
            x = taps[f"agg/global{i}"] = across(x.flatten(1, 2), joint).view(x.shape)
            if a.alt_start + 2 * i + 1 in a.out_layers:
                features.append((within[:, :, 1 + REGISTERS :], x[:, :, 1 + REGISTERS :]))
        return features


@cache
def cubic_weights(size, grid, dtype, device):
    """[size, grid] weights of antialiased cubic convolution (A = -0.5)."""
    a, scale = -0.5, grid / size
    spread = max(scale, 1)
    center = scale * (torch.arange(size, dtype=torch.float64)[:, None] + 0.5)
    u = ((torch.arange(grid) + 0.5 - center) / spread).abs()
    near = ((a + 2) * u - (a + 3)) * u * u + 1
    far = ((a * u - 5 * a) * u + 8 * a) * u - 4 * a
    weights = torch.where(u <= 1, near, torch.where(u < 2, far, 0))
    return (weights / weights.sum(1, keepdim=True)).to(device, dtype)
