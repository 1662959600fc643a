#!/usr/bin/env python3
"""Compares numbers of photos, ratios and pooling, as figures 11 and 12 of the paper do.

usage: views.py CAPTURE... [options]      needs matplotlib

Runs `zipsplat eval` for each capture, number of input photos, ratio and pooling (`--pools`) on
evenly spaced held-out photos, and `zipsplat render`. Prints means over the captures as Markdown and
plots them in views.svg. Finished runs are read from --out.
"""

import argparse
import itertools
import json
import os
import shlex
import subprocess
from pathlib import Path
from statistics import fmean

import matplotlib.pyplot as plt
from command import COMMAND, digest, timed, zipsplat

STAGES = {"backbone": "#264653", "cluster": "#e9c46a", "fuse": "#2a9d8f", "gaussians": "#e76f51"}
COLUMNS = {
    "Gaussians": ",.0f",
    "dB": ".2f",
    "s": ".2f",
    **{f"{stage}, s": ".2f" for stage in STAGES},
    "peak, MiB": ".1f",
    "pictures/s": ".1f",
    "PLY, MB": ".1f",
}
PLOTS = {"dB": "PSNR, dB", "s": "11 a: s, by stage", "peak, MiB": "11 b: peak memory, MiB",
         "pictures/s": "12 a: pictures/s", "PLY, MB": "12 b: PLY, MB"}
PICTURES = 40


def arguments():
    parser = argparse.ArgumentParser(usage=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--views", default="4,8,16,32", help="numbers of input photos")
    parser.add_argument("--ratios", default="1,0.5,auto")
    parser.add_argument("--pools", default="1", help="values of --kv-pool")
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--size", default="126x126")
    parser.add_argument("--out", type=Path, default=Path("views"), help="folder for the runs and the plots")
    parser.add_argument("--options", default="", help="more options of eval, such as --weights")
    parser.add_argument("--cpu", action="store_true", help="count CPU time over cores, loading included, for a shared machine")
    return parser.parse_args()


def measured(args, work, *words):
    """Returns a command's result and its seconds."""
    result, seconds, cpu = timed(work, *words)
    return result, cpu / os.cpu_count() if args.cpu else seconds


def draw(scene, pictures):
    """Draws 252 x 252 pixels without a file."""
    words = ["render", scene, "--size", "252x252", "--frames", str(pictures), "-o", "-", "--quiet"]
    subprocess.run([*COMMAND, *words], stdout=subprocess.DEVNULL, check=True)


def run(args, capture, views, ratio, pool):
    """Returns the values of COLUMNS. Differences of two commands leave out their other work."""
    settings = digest(args.size, args.targets, args.options, args.cpu, pool)
    folder = args.out / f"{capture.name}.{views}.{ratio}.{settings}"
    path, scene = folder / "run.json", folder / "scene.ply"
    if path.exists():
        return json.loads(path.read_text())
    words = ["--targets", args.targets, "--lpips", "none", "--views", views, "--input-size", args.size]
    network = ["--ratio", ratio, "--kv-pool", pool, *shlex.split(args.options)]
    said, whole = measured(args, zipsplat, "eval", capture, *words, *network, "-o", folder, "--overwrite")
    _, scored = measured(args, zipsplat, "eval", capture, *words, "--scene", scene, "--scene-frame", "input-cameras")
    (_, first), (_, drawn) = measured(args, draw, scene, 2), measured(args, draw, scene, 2 + PICTURES)
    stages = said["stage_seconds"]
    total = sum(stages.values())
    share = (whole - scored) / total if args.cpu else 1
    values = {
        "Gaussians": said["gaussians"],
        "dB": said["mean"]["psnr"],
        "s": share * total,
        "peak, MiB": said["peak_bytes"] / 2**20,
        "pictures/s": PICTURES / (drawn - first),
        "PLY, MB": scene.stat().st_size / 1e6,
    } | {f"{stage}, s": share * stages.get(stage, 0) for stage in STAGES}
    path.write_text(json.dumps(values))
    return values


def plot(views, curves, path):
    """Plots the columns over photos, a line per ratio, and stages as bars."""
    plt.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "zipsplat", "font.size": 8}
    figure, axes = plt.subplots(1, len(PLOTS), figsize=(13, 2.6), layout="constrained")
    for axis, (column, title) in zip(axes, PLOTS.items()):
        axis.set(title=title, xlabel="input photos")
        for j, (label, means) in enumerate(curves.items()):
            if column != "s":
                axis.plot(views, [mean[column] for mean in means], "o-", label=label)
            below = [0] * len(views)
            for stage, color in STAGES.items() if column == "s" else ():
                height = [mean[f"{stage}, s"] for mean in means]
                name = stage if j == 0 else None
                axis.bar([k + 0.25 * j for k in range(len(views))], height, 0.22, below, color=color, label=name)
                below = [sum(pair) for pair in zip(below, height)]
        if column == "s":
            axis.set_xticks(range(len(views)), views)
        else:
            axis.set(xticks=views, ylim=(None if column == "dB" else 0, None))
    axes[0].legend()
    axes[1].legend()
    figure.savefig(path, metadata={"Date": None})


def main():
    args = arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    print("| ratio | pool | photos |", " | ".join(COLUMNS), "|")
    print("|---" * (3 + len(COLUMNS)) + "|")
    curves, views = {}, list(map(int, args.views.split(",")))
    for ratio, pool, count in itertools.product(args.ratios.split(","), args.pools.split(","), views):
        runs = [run(args, capture, count, ratio, pool) for capture in args.captures]
        means = {name: fmean(values[name] for values in runs) for name in COLUMNS}
        label = f"ratio {ratio}" if pool == "1" else f"ratio {ratio}, pool {pool}"
        curves.setdefault(label, []).append(means)
        cells = (f"{means[name]:{spec}}" for name, spec in COLUMNS.items())
        print("|", " | ".join([ratio, pool, str(count), *cells]), "|", flush=True)
    plot(views, curves, args.out / "views.svg")


if __name__ == "__main__":
    main()
