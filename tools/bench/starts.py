#!/usr/bin/env python3
"""When is the network's forward pass worth its time? Refines captures from every start, and draws the PSNR of held-out photos over
seconds, mean over the captures, as starts.png beside this file; the table goes to standard output, as Markdown.
usage: starts.py CAPTURE... [--out FOLDER] [options below]

Each capture and start is one run of `zipsplat eval --refine N`, whose held-out input photos are looked at as it goes; what has
run already is read from the folder. Needs matplotlib (python3 -m pip install matplotlib) and a built zipsplat.
"""

import argparse
import json
import os
import resource
import shlex
import subprocess
import sys
import time
from pathlib import Path

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
    parser.add_argument("--zipsplat", default="zipsplat", help="the command, with any words before it")
    parser.add_argument("--starts", default="points,scene,both,tokens")
    parser.add_argument("--steps", default="10,25,50,100,200", help="steps in the table; the last is how many there are")
    parser.add_argument("--views", type=int, default=20, help="photos, those that are held out included")
    parser.add_argument("--hold-out", type=int, default=4)
    parser.add_argument("--size", default="84x84", help="of the photos that are compared")
    parser.add_argument("--options", default="--ratio auto", help="more options of eval")
    parser.add_argument("--cpu", action="store_true", help="count CPU time over cores: on a machine that others use")
    args = parser.parse_args()
    args.steps = [int(steps) for steps in args.steps.split(",")]
    args.starts = args.starts.split(",")
    return args


def run(args, capture, start):
    """What eval says, and the seconds that the whole command took, of this start."""
    path = args.out / f"{capture.name}.{start}.json"
    if not path.exists():
        steps = args.steps[-1]
        moved = [f"{steps}:tokens"] if start == "tokens" else [str(steps), "--start", start]
        words = [*shlex.split(args.zipsplat), "eval", str(capture), "--views", str(args.views), "--targets", "1", "--json", "--quiet"]
        words += ["--score-size", args.size, "--hold-out", str(args.hold_out), *shlex.split(args.options), "--refine", *moved]
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        text = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        said = json.loads(text) | {"wall": time.monotonic() - begin, "cpu": cpu / os.cpu_count()}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(said))
    return json.loads(path.read_text())


def curve(args, said, start):
    """Steps, seconds and dB: those of the forward pass and of the steps, of which all take as long."""
    rate = said["cpu"] / said["wall"] if args.cpu else 1
    forward = 0 if start == "points" else said["seconds"]
    refined = said["refined"]
    each = refined["seconds"] / max(1, refined["steps"])
    return [(step, rate * (forward + each * step), db) for step, db in refined["held_out"]]


def at(curve, step):
    """Seconds and dB after a step, between two looks in proportion."""
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
