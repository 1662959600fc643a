#!/usr/bin/env python3
"""Compares numbers of photos, ratios and pooling (figures 11 and 12 of the paper).

usage: views.py CAPTURE... [options]

Runs `zipsplat eval` for each capture, number of input photos, ratio and pooling (`--pools`) on
evenly spaced held-out photos. Prints means over the captures as Markdown: PSNR, Gaussians, times of
the network's stages, measured and planned peak memory. Finished runs are read from --out.
"""

import argparse
import itertools
import json
import os
import shlex
from pathlib import Path
from statistics import fmean

from command import timed

STAGES = ["backbone", "cluster", "fuse", "gaussians"]
COLUMNS = {
    "tokens": ",.0f",
    "Gaussians": ",.0f",
    "PLY, MB": ".1f",
    "dB": ".2f",
    "SSIM": ".3f",
    "GFLOP": ".0f",
    "s": ".2f",
    **{f"{stage}, s": ".2f" for stage in STAGES},
    "peak, MiB": ".1f",
    "planned, MiB": ".1f",
}


def arguments():
    parser = argparse.ArgumentParser(usage=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--views", default="8,24,96,176", help="numbers of input photos")
    parser.add_argument("--ratios", default="1,auto,0.1,0.01")
    parser.add_argument("--pools", default="1", help="sides of the patch groups pooled for global attention")
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--size", default="84x84")
    parser.add_argument("--out", type=Path, default=Path("views"), help="folder for the runs")
    parser.add_argument("--options", default="", help="more options of eval and info, such as --weights")
    parser.add_argument("--cpu", action="store_true", help="count CPU time over cores, for a shared machine; stages get their shares")
    return parser.parse_args()


def run(args, capture, views, ratio, pool):
    """Returns the values of COLUMNS."""
    folder = args.out / (f"{capture.name}.{views}.{ratio}" + ("" if pool == "1" else f".{pool}"))
    path = folder / "eval.json"
    if path.exists():
        return json.loads(path.read_text())
    shape = ["--views", views, "--ratio", ratio, "--kv-pool", pool, "--input-size", args.size, *shlex.split(args.options)]
    said, cpu = timed("eval", capture, *shape, "--targets", args.targets, "--lpips", "none", "-o", folder, "--overwrite")
    planned, _ = timed("reconstruct", "--dry-run", "--cameras", "capture", *shape)
    seconds = cpu / os.cpu_count() if args.cpu else said["seconds"]
    stages = said["stage_seconds"]
    scale = seconds / sum(stages.values()) if args.cpu else 1
    values = {
        "tokens": said["tokens"],
        "Gaussians": said["gaussians"],
        "PLY, MB": (folder / "scene.ply").stat().st_size / 1e6,
        "dB": said["mean"]["psnr"],
        "SSIM": said["mean"]["ssim"],
        "GFLOP": planned["flops"] / 1e9,
        "s": seconds,
        "peak, MiB": said["peak_bytes"] / 2**20,
        "planned, MiB": planned["peak_bytes"] / 2**20,
    } | {f"{stage}, s": scale * stages.get(stage, 0) for stage in STAGES}
    path.write_text(json.dumps(values))
    return values


def main():
    args = arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    print("| photos | ratio | pool |", " | ".join(COLUMNS), "|")
    print("|---" * (3 + len(COLUMNS)) + "|")
    sweep = itertools.product(map(int, args.views.split(",")), args.ratios.split(","), args.pools.split(","))
    for settings in sweep:
        runs = [run(args, capture, *settings) for capture in args.captures]
        means = (f"{fmean(values[name] for values in runs):{spec}}" for name, spec in COLUMNS.items())
        print("|", " | ".join([*map(str, settings), *means]), "|", flush=True)


if __name__ == "__main__":
    main()
