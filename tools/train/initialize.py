"""Initialization of a network that trains from scratch."""

import math

import torch
import torch.nn.functional as F
from torch import nn

SH0 = 0.28209479177387814  # the constant spherical harmonic


@torch.no_grad()
def initialize(model, cells, depth=0.9, size=0.5, opacity=-1.5, jitter=0.02, coupled=True, colors=True):
    """Initializes all weights.

    A token's Gaussians start equal (up to `jitter`), nearly transparent, `depth` in front of the
    first camera. With `colors` they start in the mean colors of the patch's `cells` (rows,
    columns). `size` and `opacity` are raw values before activation. Unless `coupled`, the head's
    weights are random.
    """
    a = model.architecture
    for name, parameter in model.named_parameters():
        if name.endswith("gamma") or (parameter.ndim == 1 and name.endswith("weight")):
            parameter.fill_(1)
        elif parameter.ndim == 1:
            parameter.zero_()
        else:
            std = parameter[0].numel() ** -0.5
            residual = name.endswith((".attn.proj.weight", ".mlp.fc2.weight", ".mlp.w3.weight"))
            nn.init.trunc_normal_(parameter, std=std / math.sqrt(2 * a.depth) if residual else std)
    vit = model.backbone.embedding()
    # Maps 0..1 to zero mean and unit contrast.
    for conv in (vit.patch_embed.proj, model.color_embed.proj):
        conv.weight.mul_(3)
        conv.bias.copy_(-0.5 * conv.weight.sum((1, 2, 3)))
    nn.init.normal_(vit.cls_token, std=0.02)
    if a.family == "da3":
        nn.init.normal_(vit.camera_token, std=0.5)
    vit.pos_embed.zero_()
    vit.pos_embed[0, 1:] = 0.5 * wave_grid(a.position_grid, a.width)

    last = model.gaussian_head.gaussian_head[1]
    rows = last.weight.unflatten(0, (a.gaussians_per_token, a.gaussian_width))
    template = 0.1 * torch.randn(rows.shape[1:]) / math.sqrt(rows.shape[-1])
    own = torch.randn(rows.shape) / math.sqrt(rows.shape[-1])
    rows.copy_(template + jitter * own if coupled else own)
    bias = torch.zeros(a.gaussian_width)
    bias[2] = math.log1p(depth)
    bias[3:6] = size
    bias[6] = 1
    bias[10] = opacity
    last.bias.copy_(bias.repeat(a.gaussians_per_token))
    if colors:
        see_colors(model, cells)
    if model.queries is not None:
        nn.init.normal_(model.queries)
        nn.init.normal_(model.color_queries, std=0.3)
    return model


def see_colors(model, cells):
    """Routes the mean colors of a patch's cells to its Gaussians.

    The color branch carries them. The head's MLP starts as the identity: gelu(x) - gelu(-x) = x.
    """
    a = model.architecture
    count, inputs = cells[0] * cells[1], a.width + a.color_width
    embed = model.color_embed.proj
    embed.weight[: 3 * count] = torch.einsum("gyx,cd->gcdyx", cell_means(cells, a.patch), torch.eye(3)).flatten(0, 1)
    embed.bias[: 3 * count] = -0.5
    branch = model.color_cross_attention
    for layer in (branch.attn.proj, branch.mlp.fc2):
        layer.weight.zero_()

    mlp, last = model.gaussian_head.gaussian_head
    through = torch.cat((torch.eye(inputs), -torch.eye(inputs)))
    mlp.fc1.weight.mul_(0.1)
    mlp.fc1.weight[: 2 * inputs] += through
    mlp.fc2.weight.mul_(0.1)
    mlp.fc2.weight[:, : 2 * inputs] += through.T
    # Colors see no tokens, whose much larger values would dominate.
    hidden = torch.cat((torch.arange(a.width, inputs), torch.arange(inputs + a.width, 2 * inputs)))
    mlp.fc1.weight[hidden] = through[hidden]
    mlp.fc2.weight[a.width :] = 0
    mlp.fc2.weight[a.width :, : 2 * inputs] = through.T[a.width :]
    constant = last.weight.unflatten(0, (a.gaussians_per_token, a.gaussian_width))[:, 11:14]
    constant.zero_()
    shown = torch.eye(3 * count).unflatten(0, (count, 3)) / SH0
    constant[..., a.width : a.width + 3 * count] = shown.repeat_interleave(a.gaussians_per_token // count, 0)


def cell_means(cells, patch):
    """[rows * columns, patch, patch]: weights that average the pixels of each cell."""
    (rows, columns), pixel = cells, torch.arange(patch)
    cell = (pixel * rows // patch)[:, None] * columns + (pixel * columns // patch)
    weights = F.one_hot(cell, rows * columns).movedim(-1, 0).float()
    return weights / weights.sum((1, 2), keepdim=True)


def wave_grid(side, width):
    """[side^2, width]: sines along y and x, with periods from four grids down to four cells."""
    quarter = width // 4
    frequency = 2 * math.pi / (4 * side * (1 / side) ** (torch.arange(quarter) / max(quarter - 1, 1)))
    waves = torch.arange(side)[:, None] * frequency
    axis = torch.cat((waves.sin(), waves.cos()), -1)
    return torch.cat((axis[:, None].expand(-1, side, -1), axis[None].expand(side, -1, -1)), -1).flatten(0, 1)
