"""Scores and pictures of a run: PSNR on fixed scenes, samples, the curve."""

import math

import numpy as np
import torch
from PIL import Image

from data import batch, fixed_split

SCENES = 16
AT_ONCE = 8


@torch.no_grad()
@torch.compiler.set_stance("force_eager")  # compiling evaluation would take minutes
def evaluate(objective, model, pool, picture=None):
    """Returns PSNR on the pool's first scenes, with and without cameras, for ratios 1 and 0.5.

    Writes inputs, targets and renders to the file `picture`.
    """
    config, device = objective.config, pool.device
    count = min(SCENES, pool.filled())
    at_once = objective.at_once(AT_ONCE, config["evaluate"][0])
    scores, grid = {}, []
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(0)
        rows = {name: value[:count] for name, value in pool.rows.items()}
        data = batch(*fixed_split(rows, *config["evaluate"]), *geometry(config))
    for given in (True, False):
        for ratio in (1.0, 0.5):
            psnr = []
            for start in range(0, count, at_once):
                part = type(data)(*(value[start : start + at_once] for value in data))
                given_scenes = torch.full((len(part.images),), given, device=device)
                _, _, pictures = objective.forward(model, part, ratio, given_scenes)
                rgb = pictures.rgb.clamp(0, 1)
                psnr.append(-10 * (rgb - part.colors).square().mean((2, 3, 4)).log10().flatten())
                if ratio == 1 and start == 0:
                    grid.append((rgb, pictures.depth))
            scores[f"{'priors' if given else 'plain'}_r{ratio:g}"] = torch.cat(psnr).mean().item()
    if picture:
        save_samples(data, grid, picture)
    return scores


def geometry(config):
    """Arguments of `batch`: number of surface points, cells of a patch, patch size."""
    return config["chamfer_points"], config["anchor_cells"], config["architecture"]["patch"]


def save_samples(data, grid, path):
    """Writes rows: two inputs; two targets as truth, with and without priors, depth."""
    (given, depth), (plain, _) = grid
    nearness = (1 / (1 + depth))[..., None].expand_as(given)
    lines = []
    for i in range(min(6, len(given))):
        tiles = [data.images[i, 0].movedim(0, -1), data.images[i, -1].movedim(0, -1)]
        for t in range(min(2, given.shape[1])):
            tiles += [data.colors[i, t], given[i, t], plain[i, t], nearness[i, t]]
        lines.append(torch.cat(tiles, 1))
    pixels = (torch.cat(lines).float().clamp(0, 1) * 255).byte().cpu().numpy()
    Image.fromarray(pixels).save(path)


def save_curve(log, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4))
    minutes = np.array([row["seconds"] for row in log]) / 60
    axes[0].plot(minutes, [row["loss"] for row in log])
    axes[0].set(xlabel="minutes", ylabel="loss", yscale="log")
    axes[1].plot(minutes, [row.get("psnr", math.nan) for row in log], color="0.7", label="training")
    for name in ("priors_r1", "priors_r0.5", "plain_r1", "plain_r0.5"):
        scored = [(t, row[name]) for t, row in zip(minutes, log) if name in row]
        if scored:
            axes[1].plot(*zip(*scored), marker=".", label=f"unseen, {name}")
    axes[1].set(xlabel="minutes", ylabel="PSNR, dB")
    axes[1].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
