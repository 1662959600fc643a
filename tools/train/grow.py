"""Weights of a larger network from those of a smaller one, with nearly the same output."""

import math

import torch
import torch.nn.functional as F

from initialize import SH0, cell_means

HEAD = [f"gaussian_head.gaussian_head.{layer}" for layer in ("0.fc1", "0.fc2", "1")]


@torch.no_grad()
def refine(tensors, architecture, count):
    """Returns weights with `count` Gaussians a token on a finer grid.

    Interpolates the head's outputs between grid points and shrinks scales with the spacing.
    """
    old, new = math.isqrt(architecture.gaussians_per_token), math.isqrt(count)
    if old < 2 or old**2 != architecture.gaussians_per_token or new**2 != count or new < old:
        raise SystemExit(f"found {architecture.gaussians_per_token} Gaussians a token in the weights and {count} in the configuration, "
                         "expected squares, of 4 at least, and no fewer: set architecture.gaussians_per_token and anchor_cells")  # fmt: skip
    place = (torch.arange(new) + 0.5) * old / new - 0.5
    before = place.floor().clamp(0, old - 2).long()
    line = torch.zeros(new, old)
    line[torch.arange(new), before] = before + 1 - place
    line[torch.arange(new), before + 1] = place - before
    grid = torch.kron(line, line)
    name = HEAD[-1]
    weight, bias = (tensors[f"{name}.{part}"].unflatten(0, (old**2, -1)) for part in ("weight", "bias"))
    weight, bias = torch.einsum("no,owi->nwi", grid, weight), grid @ bias
    bias[:, 3:6] -= math.log(new / old)  # softplus is near exp for small Gaussians
    return {**tensors, f"{name}.weight": weight.flatten(0, 1), f"{name}.bias": bias.flatten()}


@torch.no_grad()
def widen_colors(tensors, model, cells):
    """Returns weights for `model`, which has twice the color width and a wider head.

    New channels copy the old ones. One per cell also carries the part of the cell's brightness
    that the old channels do not predict; the head adds it to the color of the cell's Gaussian.
    All other new weights start without effect.
    """
    a, new = model.architecture, model.state_dict()
    count = cells[0] * cells[1]
    old_width, old_heads = a.color_width // 2, a.color_heads // 2
    inputs, hidden = a.width + old_width, tensors[f"{HEAD[0]}.bias"].numel()
    if (2 * old_width, 2 * old_heads) != (a.color_width, a.color_heads) or len(tensors["color_embed.proj.bias"]) != old_width:
        raise SystemExit(f"found a color branch of {len(tensors['color_embed.proj.bias'])} channels in the weights, "
                         f"and {a.color_width} with {a.color_heads} heads in the configuration, expected twice as many")  # fmt: skip
    if count != a.gaussians_per_token or count > old_width or a.head_hidden < hidden + 2 * count:
        raise SystemExit(f"found cells {cells}, expected one a Gaussian, and head_hidden {hidden + 2 * count} at least")

    def grown(old, like):
        """Pads `old` with zero columns and appends the random rows of `like`."""
        return torch.cat((F.pad(old, (0, like.shape[1] - old.shape[1])), like[len(old) :]))

    out = dict(tensors)
    for name, old in tensors.items():
        like = new[name]
        if old.shape == like.shape:
            continue
        if name.endswith("attn.kv_proj.weight"):
            parts = zip(old.chunk(2), like.chunk(2))
            out[name] = torch.cat([grown(*part) for part in parts])
        elif name.endswith("attn.kv_proj.bias"):
            out[name] = torch.cat([F.pad(part, (0, len(part))) for part in old.chunk(2)])
        elif name.endswith(("attn.q_proj.weight", "fc1.weight")):
            out[name] = grown(old, like)
        elif name.endswith(("attn.q_proj.bias", "fc1.bias")) or name.startswith("gaussian_head"):
            out[name] = F.pad(old, [pad for size, was in zip(like.shape[::-1], old.shape[::-1]) for pad in (0, size - was)])
        else:  # color channels
            rows = F.pad(old, (0, like.shape[1] - old.shape[1])) if old.ndim == 2 else old
            out[name] = torch.cat((rows, rows))

    old = tensors["color_embed.proj.weight"].flatten(1)
    brightness = torch.einsum("gyx,c->gcyx", cell_means(cells, a.patch), torch.tensor([0.299, 0.587, 0.114])).flatten(1)
    seen = old @ picture_covariance(a.patch)
    detail = brightness - torch.linalg.solve(seen @ old.T, seen @ brightness.T).T @ old
    embed, fc1, fc2, last = (out[f"{name}.weight"] for name in ("color_embed.proj", *HEAD))
    embed[old_width : old_width + count] += detail.view(count, *embed.shape[1:])
    out["color_embed.proj.bias"][old_width : old_width + count] -= 0.5 * detail.sum(1)  # gray is 0
    one = torch.eye(count)
    fc1[hidden : hidden + 2 * count] = 0
    for sign, row in ((1, hidden), (-1, hidden + count)):
        fc1[row : row + count, inputs : inputs + count] = sign * one
        fc1[row : row + count, a.width : a.width + count] = -sign * one
        fc2[inputs : inputs + count, row : row + count] = sign * one
    last[:, inputs + count :] = 0.1 * torch.randn(len(last), a.color_width - old_width - count) / math.sqrt(inputs)
    last.unflatten(0, (count, a.gaussian_width))[:, 11:14, inputs : inputs + count] += one[:, None] / SH0
    return out


def picture_covariance(patch):
    """Prior covariance [3 * patch^2, 3 * patch^2] of a patch's values; decays with distance."""
    pixels = torch.cartesian_prod(*[torch.arange(patch).float()] * 2)
    return torch.kron(0.9 + 0.1 * torch.eye(3), torch.exp(-torch.cdist(pixels, pixels) / patch))
