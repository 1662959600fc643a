"""The planned memory against the memory of a real step.

python tests/train/memory.py
"""

import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

TRAIN = Path(__file__).resolve().parents[2] / "tools" / "train"
sys.path.insert(0, str(TRAIN))

import torch

import plan
from model import ZipSplat
from objective import Objective
from optimizer import Optimizer
from schedule import read_config
from weights import Architecture

PRESET, TOLERANCE = TRAIN / "da3s.json", 0.15
CHANGES = (
    "size=126", "views=[4,4]", "batch_scenes=3", "views_at_once=12", "targets=1", "chamfer_points=256", "pool_gb=0", "bf16=false",
    "losses.perceptual=0", "losses.ssim=0.1", "architecture.gaussians_per_token=4",
)  # fmt: skip
TINY = ("size=28", "architecture.depth=6", "architecture.out_layers=[3,5]", "batch_scenes=1")


def step(config):
    """Two steps on zero pictures, the second with summed gradients; returns the peak in bytes."""
    model = ZipSplat(Architecture.from_json(json.dumps(config["architecture"])), 0, config["recompute"])
    optimizer, objective = Optimizer(model, config), Objective(config)
    data = plan.batch_of(config, config["batch_scenes"], config["views"][0])
    for passes in (1, 2):
        for _ in range(passes):
            objective.backward(model, data, 1.0, torch.ones(len(data.images)) > 0, config["losses"])
        optimizer.step(0.0, 1.0)
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure():
    """Prints how much steps with and without recomputation add to resident memory, in GiB."""
    step(read_config(PRESET, [*CHANGES, *TINY]))  # loads and compiles
    before = 1024 * int(re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[1])
    for recompute in ("true", "false"):
        print((step(read_config(PRESET, [*CHANGES, f"recompute={recompute}"])) - before) / plan.GIB)


def the_plan_is_what_a_step_takes():
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
    output = subprocess.run([sys.executable, __file__, "measure"], env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    totals = []
    for recompute, found in zip(("true", "false"), map(float, output.split())):
        planned = plan.report(read_config(PRESET, [*CHANGES, f"recompute={recompute}"]))
        totals.append(float(planned.split()[-3]))
        print(f"recompute {recompute}: planned {totals[-1]:.2f} GiB, measured {found:.2f}")
        assert abs(totals[-1] / found - 1) < TOLERANCE, f"found {found} GiB, planned {planned}"
    assert totals[0] < 0.8 * totals[1], f"found {totals[0]} GiB with recomputation, expected much less than {totals[1]}"


def the_published_training_fits_one_gpu_of_80_gb():
    planned = plan.report(read_config(TRAIN / "paper.json"))
    print(planned)
    assert planned.startswith("1,447,701,472 parameters") and float(planned.split()[-3]) * plan.GIB < 72e9, planned


if __name__ == "__main__":
    torch.set_num_threads(1)
    if sys.argv[1:] == ["measure"]:
        sys.exit(measure())
    the_plan_is_what_a_step_takes()
    the_published_training_fits_one_gpu_of_80_gb()
