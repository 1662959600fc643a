"""Trains variants of one network from the same weights on the same scenes and prints the table.

    python tools/train/ablate.py --backbone engine/models/nano.safetensors --out DIR --steps 120

The rows follow the paper's table 4b and c, and add learned queries. Finished runs are skipped.
`--set NAME=JSON` changes a setting of all runs.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from safetensors import safe_open

HERE = Path(__file__).resolve().parent
# Small enough for a CPU, where AdamW's steps take much less time than Muon's. The color branch
# fits 64 Gaussians per token.
SMALL = {
    "size": 56, "views": [2, 2], "evaluate": [2, 2], "targets": 2, "batch_views": 8, "record_views": 6, "scenes": 64, "ratio": 0.5,
    "progressive": False, "geometry_until": 0, "geometry_after": 0, "architecture.gaussians_per_token": 32, "anchor_cells": [4, 8],
    "architecture.color_width": 192, "architecture.color_heads": 3, "architecture.color_hidden": 192, "architecture.head_hidden": 768,
    "log_seconds": 1, "ema": 0.98, "muon": False,
}  # fmt: skip
# Losses that learned queries cannot have, since they belong to no patch.
FREE = {"losses.anchor": 0, "losses.ray": 0, "losses.color": 0}
TOKENS = 2 * (56 // 14) ** 2


def gaussians(count, cells):
    return {"architecture.gaussians_per_token": count, "anchor_cells": cells}


VARIANTS = {
    "full, 32 Gaussians a token": {},
    "without coupled initialization": {"initial.coupled": False},
    "without low opacity": {"initial.opacity": 0.0},
    "without a place in front of the camera": {"initial.depth": 0.0},
    "without the loss of depth": {"losses.depth": 0},
    "without the geometric loss": {"losses.chamfer": 0},
    "8 Gaussians a token": gaussians(8, [2, 4]),
    "16 Gaussians a token": gaussians(16, [4, 4]),
    "64 Gaussians a token": gaussians(64, [8, 8]),
    "tokens of the scene, without anchors and rays": FREE,
    f"{TOKENS} learned queries, the same losses": {**FREE, "queries": TOKENS},
    f"{TOKENS // 2} learned queries, the same losses": {**FREE, "queries": TOKENS // 2},
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--zipsplat", default="target/release/zipsplat")
    parser.add_argument("--backbone", required=True, help="weights that provide the initial backbone")
    parser.add_argument("--out", type=Path, required=True, help="folder with one subfolder per run")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=JSON", help="changes a setting of all runs")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the runs, counted from 0")
    args = parser.parse_args()

    def run(out, changes):
        changes = [f"{name}={json.dumps(value)}" for name, value in {**SMALL, **changes}.items()] + args.set
        command = [sys.executable, str(HERE / "train.py"), "--config", str(HERE / "pocket.json"), "--out", str(out)]
        command += ["--zipsplat", args.zipsplat, "--backbone", args.backbone, "--steps", str(args.steps)]
        subprocess.run([*command, *(part for change in changes for part in ("--set", change))], check=True, stdout=sys.stderr)

    print("| | Gaussians | all tokens | a half of them | all, without cameras |\n|---|---|---|---|---|")
    for i in args.only or range(len(VARIANTS)):
        name, changes = list(VARIANTS.items())[i]
        out = args.out / f"{i:02}"
        if not (out / "model.safetensors").exists():
            run(out, changes)
        with safe_open(out / "model.safetensors", "np") as file:
            training = json.loads(file.metadata()["zipsplat.training"])
        config, scores = training["config"], training["unseen_psnr"]
        count = (config["queries"] or TOKENS) * config["architecture"]["gaussians_per_token"]
        half = "-" if config["queries"] else f"{scores['priors_r0.5']:.2f}"
        print(f"| {name} | {count:,} | {scores['priors_r1']:.2f} | {half} | {scores['plain_r1']:.2f} |", flush=True)


if __name__ == "__main__":
    main()
