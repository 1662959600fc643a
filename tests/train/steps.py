"""Steps of training: recomputed activations, split batches and two processes change nothing.

python tests/train/steps.py
"""

import copy
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

TRAIN = Path(__file__).resolve().parents[2] / "tools" / "train"
sys.path.insert(0, str(TRAIN))

import torch
import torch.distributed as dist

from data import Batch, batch
from initialize import initialize
from model import ZipSplat
from objective import Objective
from optimizer import Optimizer
from parallel import device_of_process, distribute, full_state, rank_and_processes
from schedule import read_config
from weights import Architecture

NETWORK = {
    "width": 64, "depth": 3, "heads": 1, "ffn": "gelu", "ffn_hidden": 256, "position_grid": 5, "alt_start": 1, "qk_norm_start": 1,
    "rope_start": 1, "out_layers": [1, 2], "camera_depth": 1, "camera_heads": 1, "camera_hidden": 256, "camera_pose_hidden": 32,
    "fusion_heads": 1, "fusion_hidden": 256, "color_width": 32, "color_heads": 1, "head_hidden": 192, "gaussians_per_token": 4,
}  # fmt: skip
CHANGES = {"losses.perceptual": 0, "losses.ssim": 0.1, "bf16": False, "recompute": False, "views_at_once": 0, "views": [2, 2], "size": 42,
           **{f"architecture.{name}": value for name, value in NETWORK.items()}}  # fmt: skip
SCENES, STEPS, RATE = 4, 4, 3e-4


def preset(**changes):
    return read_config(TRAIN / "paper.json", [f"{name}={json.dumps(value)}" for name, value in {**CHANGES, **changes}.items()])


def scenes(count=SCENES, views=4, side=42, cells=(1, 1)):
    """Returns a batch of random scenes: two context views, one target."""
    rows = {
        "intrinsics": torch.tensor([40.0, 40.0, side / 2, side / 2]).expand(count, views, 4),
        "poses": torch.eye(4)[:3].repeat(count, views, 1, 1),
        "colors": torch.randint(256, (count, views, side, side, 3), dtype=torch.uint8),
        "depths": 1 + torch.rand(count, views, side, side),
    }
    rows["poses"][:, :, 0, 3] = 0.1 * torch.arange(views)
    context, targets = torch.tensor([[0, 1]]).expand(count, -1), torch.tensor([[2]]).expand(count, -1)
    return batch(rows, context, targets, 64, cells, 14)


def network(config):
    torch.manual_seed(0)
    model = ZipSplat(Architecture.from_json(json.dumps(config["architecture"])), recompute=config["recompute"])
    return initialize(model, config["anchor_cells"], **config["initial"])


def gradients_do_not_depend_on_recomputation_or_parts():
    data, given = scenes(), torch.arange(SCENES) % 2 == 0
    found = {}
    for name, changes in {"plain": {}, "recomputed": {"recompute": True}, "in parts": {"views_at_once": 6}, "both": {"recompute": True, "views_at_once": 2}}.items():
        config = preset(**changes)
        model, calls = network(config), []
        block = model.backbone.backbone.blocks[0]
        compute = block.compute
        block.compute = lambda *inputs: calls.append(1) or compute(*inputs)
        measured = Objective(config).backward(model, data, 1.0, given, config["losses"])
        found[name] = torch.cat([p.grad.flatten() for p in model.parameters()]), measured["loss"], len(calls)
    exact, loss, _ = found["plain"]
    assert exact.norm() > 0.1, exact.norm()
    for name, (gradients, other, _) in found.items():
        error = ((gradients - exact).norm() / exact.norm()).item()
        assert error < 1e-5 and abs(other - loss) < 1e-5 * loss, (name, error, other, loss)
    # A block of a local layer runs once a part, and once more where it is recomputed.
    assert [calls for _, _, calls in found.values()] == [1, 2, 2, 8], [calls for _, _, calls in found.values()]


def train(config, data, given, resume=None):
    """Steps on this process's share of the batch; returns measurements, model and optimizer."""
    rank, processes = rank_and_processes()
    model = network(config)
    if resume:
        model.load_state_dict(resume["model"])
    average = distribute(copy.deepcopy(model).requires_grad_(False), config["shard"])
    optimizer, objective = Optimizer(distribute(model, config["shard"]), config), Objective(config)
    if resume:
        optimizer.load_state_dict(resume["optimizer"])
    part, given, measured = Batch(*(value[rank::processes] for value in data)), given[rank::processes], []
    for _ in range(STEPS):
        loss = objective.backward(model, part, 1.0, given, config["losses"])["loss"]
        norm = optimizer.step(RATE, config["clip"])
        with torch.no_grad():
            torch._foreach_lerp_(list(average.parameters()), list(model.parameters()), 0.5)
            opacity = objective.forward(average, part, 1.0, given, draw=False)[0][..., 10].mean()
        sums = torch.stack((loss, opacity))
        if processes > 1:
            dist.all_reduce(sums)
        measured.append([*(sums / processes).tolist(), norm.item()])
    return measured, model, optimizer


def steps_of_one_process(path):
    """Two runs of a few steps with the optimizer's state between them, or by torchrun its share."""
    torch.manual_seed(1)
    data, given, found = scenes(), torch.arange(SCENES) % 3 == 0, {}
    device_of_process()
    for muon in (False, True):
        config = preset(muon=muon, shard=not muon)
        first, model, optimizer = train(config, data, given)
        state = {"model": full_state(model), "optimizer": optimizer.state_dict()}
        second, model, _ = train(config, data, given, copy.deepcopy(state))
        found[muon] = {"measured": first + second, "state": state, "weights": full_state(model)}
    if rank_and_processes()[0] == 0:
        torch.save(found, path)
    if dist.is_initialized():
        dist.destroy_process_group()


def two_processes_learn_as_one_does():
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        for launcher, name in (([], "one"), (["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"], "two")):
            subprocess.run([sys.executable, *launcher, __file__, f"{folder}/{name}"], env=environment, check=True)
        one, two = (torch.load(f"{folder}/{name}", weights_only=True) for name in ("one", "two"))
    # Relative, of loss, opacity by averaged weights, and the gradient's norm, which amplifies
    # rounding. Muon iterates in bf16.
    limits = {False: torch.tensor([1e-3, 1e-3, 1e-2]), True: torch.tensor([2e-2, 2e-2, 1e-1])}
    for muon, limit in limits.items():
        exact, found = (torch.tensor(run[muon]["measured"]) for run in (one, two))
        assert exact[0, 0] > 1.1 * exact[:, 0].min() and abs(exact[-1, 1] / exact[0, 1] - 1) > 0.05, exact
        assert ((exact - found).abs() < limit * exact).all(), (muon, exact, found)
        assert one[muon]["weights"].keys() == two[muon]["weights"].keys()
    # The checkpoint of two processes continues in one.
    config, data = preset(), two[False]
    torch.manual_seed(1)
    resumed, _, _ = train(config, scenes(), torch.arange(SCENES) % 3 == 0, data["state"])
    resumed, expected = torch.tensor(resumed), torch.tensor(data["measured"][STEPS:])
    assert ((resumed - expected).abs() < limits[False] * expected).all(), (resumed, expected)


TESTS = (gradients_do_not_depend_on_recomputation_or_parts, two_processes_learn_as_one_does)

if __name__ == "__main__":
    torch.set_num_threads(1)
    if sys.argv[1:]:
        sys.exit(steps_of_one_process(sys.argv[1]))
    for test in TESTS:
        torch.manual_seed(0)
        test()
        print(f"{test.__name__}: passed")
