"""Measures the embedded model (or --weights) and prints the tables of engine/models/README.md as Markdown.

    python tools/train/card.py --zipsplat target/release/zipsplat --captures FOLDER

Every number is the mean that `zipsplat eval` prints. Scenes are procedural ones that training never sees; captures are the
folders of FOLDER that have a transforms.json.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

# Training counts seeds up from 0 and evaluates itself from 2^40 on.
FIRST_SEED, SCENES, SCENE_VIEWS = 1 << 41, 20, 16
INPUTS, RATIOS = (4, 8), (1, 0.5, 0.25)
CAPTURE_INPUTS = 8


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zipsplat", default="target/release/zipsplat")
    parser.add_argument("--weights", help="instead of the embedded model")
    parser.add_argument("--captures", help="folder of captures")
    parser.add_argument("--out", help="folder to keep every comparison.png in")
    args = parser.parse_args()
    weights = ["--weights", args.weights] if args.weights else []

    def evaluate(folder, inputs, ratio, name):
        keep = ["-o", str(Path(args.out) / name)] if args.out else []
        command = [args.zipsplat, "eval", folder, "--views", str(inputs), "--ratio", str(ratio), "--json", *weights, *keep]
        return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["mean"]

    with tempfile.TemporaryDirectory() as places:
        for scene in range(SCENES):
            command = [args.zipsplat, "scene", "--seed", str(FIRST_SEED + scene), "--views", str(SCENE_VIEWS), "-q"]
            subprocess.run([*command, "-o", f"{places}/{scene}"], check=True)
        print(f"| {SCENES} procedural scenes | ratio | PSNR | SSIM | nearest photo | its mean colour |\n|---|---|---|---|---|---|")
        for inputs in INPUTS:
            for ratio in RATIOS:
                means = [evaluate(f"{places}/{i}", inputs, ratio, f"scene{i}-{inputs}-{ratio}") for i in range(SCENES)]
                print(f"| {inputs} inputs | {ratio} | {' | '.join(cells(average(means)))} |", flush=True)
    if args.captures:
        print(f"\n| capture, {CAPTURE_INPUTS} inputs | PSNR | SSIM | nearest photo | its mean colour | above the better |")
        print("|---|---|---|---|---|---|")
        means = {}
        for path in sorted(Path(args.captures).glob("*/transforms.json")):
            mean = means[path.parent.name] = evaluate(path.parent, CAPTURE_INPUTS, 1, path.parent.name)
            print(f"| {path.parent.name} | {' | '.join(cells(mean))} | {gain(mean):+.2f} |", flush=True)
        total = average(list(means.values()))
        gains = sum(map(gain, means.values())) / len(means)
        print(f"| **mean** | {' | '.join(cells(total))} | {gains:+.2f} |")


def average(means):
    names = ("psnr", "ssim", "nearest_psnr", "mean_colour_psnr")
    return {name: sum(mean[name] for mean in means) / len(means) for name in names}


def gain(mean):
    """dB above the better of the two trivial predictions."""
    return mean["psnr"] - max(mean["nearest_psnr"], mean["mean_colour_psnr"])


def cells(mean):
    return [f"{mean['psnr']:.2f}", f"{mean['ssim']:.3f}", f"{mean['nearest_psnr']:.2f}", f"{mean['mean_colour_psnr']:.2f}"]


if __name__ == "__main__":
    main()
