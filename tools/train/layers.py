"""Layers: patch embedding, attention with rotary embedding, transformer blocks.

Shapes: B scenes, n tokens, D width.
"""

import math
from functools import cache

import torch
import torch.nn.functional as F
from torch import nn
from torch.utils.checkpoint import checkpoint


class Recomputed(nn.Module):
    """A block that with `recompute` keeps only its inputs for the backward pass."""

    recompute = False

    def forward(self, *inputs):
        if self.recompute and torch.is_grad_enabled():
            return checkpoint(self.compute, *inputs, use_reentrant=False)
        return self.compute(*inputs)


class Mlp(nn.Module):
    def __init__(self, inputs, hidden, outputs):
        super().__init__()
        self.fc1 = nn.Linear(inputs, hidden)
        self.fc2 = nn.Linear(hidden, outputs)

    def forward(self, x):
        return self.fc2(F.gelu(self.fc1(x)))


class SwiGlu(nn.Module):
    def __init__(self, width, hidden):
        super().__init__()
        self.w12 = nn.Linear(width, 2 * hidden)
        self.w3 = nn.Linear(hidden, width)

    def forward(self, x):
        gate, value = self.w12(x).chunk(2, -1)
        return self.w3(F.silu(gate) * value)


class LayerScale(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(width))

    def forward(self, x):
        return x * self.gamma


class PatchEmbed(nn.Module):
    def __init__(self, width, patch):
        super().__init__()
        self.proj = nn.Conv2d(3, width, patch, patch)

    def forward(self, images):
        """[N, 3, H, W] -> [N, T, D]"""
        return self.proj(images).flatten(2).transpose(1, 2)


def resampled(learned, rows, columns, weights):
    """Position embeddings, resampled by `weights` along each axis."""
    grid = math.isqrt(learned.shape[1])
    if rows == columns == grid:
        return learned
    y, x = (weights(size, grid, learned.dtype, learned.device) for size in (rows, columns))
    return torch.einsum("ip,jq,pqd->ijd", y, x, learned[0].unflatten(0, (grid, grid))).flatten(0, 1)[None]


def rotate(x, rope):
    """Rotates pairs of channels of [..., n, head_dim] by the angles of `rope_table`."""
    cos, sin = rope
    pairs = x.unflatten(-1, (2, 2, -1))
    turned = torch.stack((-pairs[..., 1, :], pairs[..., 0, :]), -2).flatten(-3)
    return x * cos + turned * sin


@cache
def rope_table(rows, columns, views, head_dim, dtype, device):
    """cos and sin [n, head_dim] of a local block (`views` 0) or a global one (patches at (1, 1)).

    The first half of a head encodes y, the second x.
    """
    y, x = torch.meshgrid(torch.arange(rows) + 1, torch.arange(columns) + 1, indexing="ij")
    patches = torch.stack((y, x), -1).flatten(0, 1)
    patches = torch.ones_like(patches) if views else patches
    positions = torch.cat((torch.zeros(1, 2), patches)).repeat(max(views, 1), 1).double()
    quarter = head_dim // 4
    frequency = 100.0 ** (-torch.arange(quarter, dtype=torch.float64) / quarter)
    angles = (positions[:, :, None, None] * frequency).expand(-1, 2, 2, quarter).flatten(1)
    return angles.cos().to(device, dtype), angles.sin().to(device, dtype)


class Attention(nn.Module):
    """Self-attention, or with `cross` from queries to a context."""

    def __init__(self, width, heads, qk_norm, cross=False):
        super().__init__()
        self.heads = heads
        if cross:
            self.q_proj = nn.Linear(width, width)
            self.kv_proj = nn.Linear(width, 2 * width)
        else:
            self.qkv = nn.Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // heads) if qk_norm else None
        self.k_norm = nn.LayerNorm(width // heads) if qk_norm else None
        self.proj = nn.Linear(width, width)

    def forward(self, x, context=None, rope=None):
        if context is None:
            q, k, v = self.split(self.qkv(x), 3)
        else:
            (q,) = self.split(self.q_proj(x), 1)
            k, v = self.split(self.kv_proj(context), 2)
        if self.q_norm is not None:
            q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rotate(q, rope), rotate(k, rope)
        mixed = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)
        return self.proj(mixed.transpose(1, 2).flatten(2))

    def split(self, x, parts):
        """[B, n, parts * D] -> parts of [B, heads, n, head_dim]"""
        return x.unflatten(-1, (parts, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)


class Block(Recomputed):
    def __init__(self, width, heads, mlp, qk_norm, eps=1e-5):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps)
        self.attn = Attention(width, heads, qk_norm)
        self.ls1 = LayerScale(width)
        self.norm2 = nn.LayerNorm(width, eps)
        self.mlp = mlp
        self.ls2 = LayerScale(width)

    def compute(self, x, rope=None):
        x = x + self.ls1(self.attn(self.norm1(x), rope=rope))
        return x + self.ls2(self.mlp(self.norm2(x)))


class CrossBlock(Recomputed):
    def __init__(self, width, heads, hidden):
        super().__init__()
        self.norm_q = nn.LayerNorm(width)
        self.norm_kv = nn.LayerNorm(width)
        self.attn = Attention(width, heads, qk_norm=True, cross=True)
        self.ls1 = LayerScale(width)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = Mlp(width, hidden, width)
        self.ls2 = LayerScale(width)

    def compute(self, queries, context):
        """Returns the residual to add to the queries."""
        delta = self.ls1(self.attn(self.norm_q(queries), self.norm_kv(context)))
        return delta + self.ls2(self.mlp(self.norm2(queries + delta)))
