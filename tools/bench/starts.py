#!/usr/bin/env python3
"""Compares initializations of refinement: PSNR of held-out photos over seconds, mean over captures.

usage: starts.py CAPTURE... [--out FOLDER] [options below]

Writes starts.png next to this file and prints a Markdown table. Runs `zipsplat eval --refine N` for
each capture and initialization; finished runs are read from FOLDER. Needs matplotlib and a built
zipsplat, or $ZIPSPLAT.
"""

import argparse
import json
import os
import shlex
import sys
import time
from pathlib import Path

from command import timed

COLORS = {"points": "#0072B2", "scene": "#D55E00", "both": "#009E73", "tokens": "#CC79A7"}
NAMES = {
    "points": "the capture's points",
    "scene": "the network's Gaussians",
    "both": "both together",
    "tokens": "the network's tokens",
}


def arguments():
    parser = argparse.ArgumentParser(usage=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("starts"), help="folder for the runs")
    parser.add_argument("--png", type=Path, default=Path(__file__).with_name("starts.png"))
    parser.add_argument("--starts", default="points,scene,both,tokens")
    parser.add_argument("--steps", default="10,25,50,100,200", help="steps in the table; the last ends a run")
    parser.add_argument("--views", type=int, default=20, help="photos, including held-out ones")
    parser.add_argument("--hold-out", type=int, default=4)
    parser.add_argument("--size", default="84x84", help="size of the compared pictures")
    parser.add_argument("--options", default="--ratio auto", help="more options of eval")
    parser.add_argument("--cpu", action="store_true", help="count CPU time over cores, for a shared machine")
    args = parser.parse_args()
    args.steps = [int(steps) for steps in args.steps.split(",")]
    args.starts = args.starts.split(",")
    return args


def run(args, capture, start):
    """Returns the result of eval with wall and CPU seconds."""
    path = args.out / f"{capture.name}.{start}.json"
    if not path.exists():
        steps = args.steps[-1]
        moved = [str(steps), "--refine-target", "tokens"] if start == "tokens" else [str(steps), "--init", start]
        words = ["eval", capture, "--views", args.views, "--targets", "1"]
        words += ["--eval-size", args.size, "--holdout-views", args.hold_out, *shlex.split(args.options), "--refine", *moved]
        begin = time.monotonic()
        said, cpu = timed(*words)
        said |= {"wall": time.monotonic() - begin, "cpu": cpu / os.cpu_count()}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(said))
    return json.loads(path.read_text())


def curve(args, said, start):
    """Returns (step, seconds, dB) at each evaluation, including the forward pass."""
    rate = said["cpu"] / said["wall"] if args.cpu else 1
    forward = 0 if start == "points" else said["seconds"]
    refined = said["refined"]
    each = refined["seconds"] / max(1, refined["steps"])
    return [(step, rate * (forward + each * step), db) for step, db in refined["holdout_psnr_by_step"]]


def at(curve, step):
    """Interpolates seconds and dB at a step."""
    before = max(place for place in curve if place[0] <= step)
    after = min(place for place in curve if place[0] >= step)
    along = (step - before[0]) / max(1, after[0] - before[0])
    return [(1 - along) * a + along * b for a, b in zip(before[1:], after[1:])]


def means(places):
    return [sum(values) / len(values) for values in zip(*places)]


def main():
    args = arguments()
    curves = {start: [] for start in args.starts}
    for capture in args.captures:
        for start in args.starts:
            print(f"{capture.name}, {start}", file=sys.stderr)
            curves[start].append(curve(args, run(args, capture, start), start))

    print(f"| start | steps 0 | {' | '.join(map(str, args.steps))} |\n|---|---|{'---|' * len(args.steps)}")
    for start, all_of in curves.items():
        cells = [means([at(curve, step) for curve in all_of]) for step in [0, *args.steps]]
        print(f"| {NAMES[start]} | {' | '.join(f'{db:.2f} dB, {seconds:.1f} s' for seconds, db in cells)} |")

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.2), dpi=90)
    for start, all_of in curves.items():
        steps = sorted({step for curve in all_of for step, *_ in curve})
        seconds, decibels = zip(*(means([at(curve, step) for curve in all_of]) for step in steps))
        axes.plot(seconds, decibels, "o-", ms=3, color=COLORS[start], label=NAMES[start])
    axes.set_xlabel("seconds from photos to Gaussians")
    axes.set_ylabel("PSNR of held-out photos, dB")
    axes.set_xscale("symlog", linthresh=1)
    axes.set_xlim(left=0)
    axes.set_xticks([0, 0.5, 1, 2, 5, 10, 20, 50], labels=["0", "0.5", "1", "2", "5", "10", "20", "50"])
    axes.grid(alpha=0.3)
    axes.legend(title="start", loc="lower right")
    figure.tight_layout()
    figure.savefig(args.png, metadata={"Software": None})


main()
