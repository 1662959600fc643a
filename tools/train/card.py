"""Prints the tables of engine/models/README.md for the built-in model or --weights.

    python tools/train/card.py --zipsplat target/release/zipsplat --captures FOLDER

Numbers are means of `zipsplat eval`. Procedural scenes are disjoint from training. Captures are
subfolders of FOLDER with a transforms.json. Without cameras, renders are aligned with 4 photos.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

# Training seeds count up from 0, its validation's from 2^40.
FIRST_SEED, SCENES, SCENE_VIEWS = 1 << 41, 20, 16
INPUTS, RATIOS = (4, 8), (1, 0.5, 0.25)
CAPTURE_INPUTS = 8
POSE_FREE = ("--pose-free", "--targets", "4")
HEADINGS = "\n| {} | PSNR | SSIM | nearest photo | its mean color | above the better |\n|---|---|---|---|---|---|"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zipsplat", default="target/release/zipsplat")
    parser.add_argument("--weights", help="instead of the built-in model")
    parser.add_argument("--captures", help="folder of captures")
    parser.add_argument("--out", help="folder for every comparison.png")
    args = parser.parse_args()
    weights = ["--weights", args.weights] if args.weights else []
    captures = sorted(path.parent for path in Path(args.captures).glob("*/transforms.json")) if args.captures else []

    def evaluate(folder, inputs, ratio, name, *more):
        keep = ["-o", str(Path(args.out) / name)] if args.out else []
        command = [args.zipsplat, "eval", folder, "--views", str(inputs), "--ratio", str(ratio), "--json", *weights, *keep, *more]
        return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["result"]["mean"]

    def row(name, means):
        gains = sum(map(gain, means)) / len(means)
        print(f"| {name} | {' | '.join(cells(average(means)))} | {gains:+.2f} |", flush=True)

    with tempfile.TemporaryDirectory() as places:
        scenes = [f"{places}/{i}" for i in range(SCENES)]
        for i, scene in enumerate(scenes):
            command = [args.zipsplat, "scene", "--seed", str(FIRST_SEED + i), "--views", str(SCENE_VIEWS), "-q"]
            subprocess.run([*command, "-o", scene], check=True)
        print(f"| {SCENES} procedural scenes | ratio | PSNR | SSIM | nearest photo | its mean color |\n|---|---|---|---|---|---|")
        for inputs in INPUTS:
            for ratio in RATIOS:
                means = [evaluate(scene, inputs, ratio, f"scene{i}-{inputs}-{ratio}") for i, scene in enumerate(scenes)]
                print(f"| {inputs} inputs | {ratio} | {' | '.join(cells(average(means)))} |", flush=True)
        if captures:
            print(HEADINGS.format(f"capture, {CAPTURE_INPUTS} inputs"))
            means = {path.name: evaluate(path, CAPTURE_INPUTS, 1, path.name) for path in captures}
            for name, mean in means.items():
                row(name, [mean])
            row("**mean**", list(means.values()))
        print(HEADINGS.format("without cameras, aligned"))
        for inputs in INPUTS:
            means = [evaluate(scene, inputs, 1, f"scene{i}-{inputs}-free", *POSE_FREE) for i, scene in enumerate(scenes)]
            row(f"{SCENES} procedural scenes, {inputs} inputs", means)
        if captures:
            means = [evaluate(path, CAPTURE_INPUTS, 1, f"{path.name}-free", *POSE_FREE) for path in captures]
            row(f"{len(captures)} captures, {CAPTURE_INPUTS} inputs", means)


def average(means):
    names = ("psnr", "ssim", "nearest_psnr", "mean_color_psnr")
    return {name: sum(mean[name] for mean in means) / len(means) for name in names}


def gain(mean):
    """Returns the dB above the better of the two trivial predictions."""
    return mean["psnr"] - max(mean["nearest_psnr"], mean["mean_color_psnr"])


def cells(mean):
    return [f"{mean['psnr']:.2f}", f"{mean['ssim']:.3f}", f"{mean['nearest_psnr']:.2f}", f"{mean['mean_color_psnr']:.2f}"]


if __name__ == "__main__":
    main()
