"""Trains variants of one network from the same backbone on the same scenes and prints the table.

    python tools/train/ablate.py --config tools/train/da3s.json --out DIR --lpips FILE \\
        --backbone da3-small/model.safetensors --data re10k:RE10K/train --depths DEPTHS

The rows follow the paper's tables 4b and 4c. Finished runs are skipped, others resumed.
Other options go to train.py.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

from safetensors import safe_open

from schedule import read_config

TRAIN = Path(__file__).resolve().parent / "train.py"
VARIANTS = {
    "full": {},
    "without coupled initialization": {"initial.coupled": False},
    "without opacity bias": {"initial.opacity": 0},
    "without position bias": {"initial.depth": 0},
    "without depth loss": {"losses.depth": 0},
    "without geometric loss": {"losses.chamfer": 0},
    "8 Gaussians a token": {"architecture.gaussians_per_token": 8},
    "16 Gaussians a token": {"architecture.gaussians_per_token": 16},
    "64 Gaussians a token": {"architecture.gaussians_per_token": 64},
}
SCORES = ("priors_r1", "priors_r0.5", "plain_r1")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder with one subfolder per run")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="runs of each variant")
    parser.add_argument("--only", type=int, nargs="+", help="numbers of the variants, counted from 0")
    args, options = parser.parse_known_args()
    config = read_config(args.config)

    def run(i, seed):
        """Returns the scores of a variant, trained unless it is there."""
        out = args.out / f"{i:02}-{seed}"
        finished = out / "scores.json"
        if not finished.exists():
            changes = {**list(VARIANTS.values())[i], "seed": seed}
            sets = [part for name, value in changes.items() for part in ("--set", f"{name}={json.dumps(value)}")]
            resume = ["--resume", out] if (out / "state.pt").exists() else []
            command = [sys.executable, TRAIN, "--config", args.config, "--out", out, *options, *sets, *resume]
            subprocess.run(command, check=True, stdout=sys.stderr)
            with safe_open(out / "model.safetensors", "np") as file:
                finished.write_text(json.dumps(json.loads(file.metadata()["zipsplat.training"])["unseen_psnr"]))
        return json.loads(finished.read_text())

    chosen = args.only or range(len(VARIANTS))
    # Seed by seed: an interrupted ablation has whole rows.
    scores = {}
    for seed in args.seeds:
        for i in chosen:
            scores.setdefault(i, []).append(run(i, seed))
    tokens = config["evaluate"][0] * (config["size"] // config["architecture"]["patch"]) ** 2
    print("| | Gaussians | all tokens | half | without cameras |\n|---|---|---|---|---|")
    for i in chosen:
        name, changes = list(VARIANTS.items())[i]
        count = tokens * changes.get("architecture.gaussians_per_token", config["architecture"]["gaussians_per_token"])
        columns = [[row[score] for row in scores[i]] for score in SCORES]
        print(f"| {name} | {count:,} | {' | '.join(map(cell, columns))} |")


def cell(values):
    """Mean and, over several seeds, standard deviation."""
    return f"{statistics.mean(values):.2f}" + (f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else "")


if __name__ == "__main__":
    main()
