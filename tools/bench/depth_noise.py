"""Measures refinement from noisy depth.

    depth_noise.py [--seeds 1,2,3] [--noise 0,1,5,10] [--steps 100] [--size 126x126]

Initializes one Gaussian per pixel of 8 photos of each procedural place, from exact depth and with
smooth relative errors in percent, and refines with equal steps. The baseline starts from the
place's points. Prints mean PSNR of held-out photos as Markdown. $ZIPSPLAT is the command.
"""

import argparse
import tempfile
from pathlib import Path

from command import zipsplat


def judged(place, options, *words):
    """Returns the PSNR of held-out photos."""
    line = ["eval", place, "--views", options.views, "--input-size", options.size, "--lpips", "none", *words]
    return zipsplat(*line)["mean"]["psnr"]


parser = argparse.ArgumentParser()
parser.add_argument("--seeds", default="1,2,3")
parser.add_argument("--noise", default="0,1,5,10")
parser.add_argument("--steps", default="100")
parser.add_argument("--size", default="126x126")
parser.add_argument("--views", default="8")
parser.add_argument("--photos", default="20")
options = parser.parse_args()
starts = {f"depth, {noise} % off": ["--depth-noise", noise] for noise in options.noise.split(",")}
found = {name: [] for name in [*starts, "points"]}
for seed in options.seeds.split(","):
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "place"
        zipsplat("scene", "--seed", seed, "--views", options.photos, "--size", options.size, "-o", place)
        refine = ["--refine", options.steps, "--holdout-views", 0]
        for name, words in starts.items():
            depth = ["--from-depth", place / "depth", *words]
            found[name].append([judged(place, options, *depth), judged(place, options, *depth, *refine)])
        found["points"].append([None, judged(place, options, *refine, "--init", "points")])
print(f"| start | before | after {options.steps} steps | each place after |\n|---|---|---|---|")
for name, rows in found.items():
    before, after = ([row[k] for row in rows] for k in (0, 1))
    mean = f"{sum(before) / len(before):.2f} dB" if None not in before else ""
    each = ", ".join(f"{value:.2f}" for value in after)
    print(f"| {name} | {mean} | {sum(after) / len(after):.2f} dB | {each} |")
