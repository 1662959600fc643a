"""Trains the network on procedural scenes, generated during training, or on photos.

    python tools/train/train.py --config tools/train/nano.json --out DIR --minutes 25

On CPUs use one process per core: `torchrun --nproc-per-node 2 tools/train/train.py ...`.
DIR receives model.safetensors (averaged weights, f16), state.pt (checkpoint), log.csv, curve.png
and samples/. `--resume DIR` continues within the same time budget; `--resume FILE.safetensors`
starts a new schedule from weights.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before PyTorch; the generator shares the cores

import argparse
import copy
import csv
import json
import math
import random
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from safetensors.torch import load_file

import backbone
import losses
import paper
import plan


import weights as files
from captures import Captures
from data import Pool, Shards, generator_command, record
from evaluation import SCENES, evaluate, geometry, save_curve
from grow import refine, widen_colors
from initialize import initialize
from model import ZipSplat
from objective import Objective
from optimizer import Optimizer
from parallel import device_of_process, distribute, full_state, rank_and_processes
from schedule import Schedule, read_config

ROOT = Path(__file__).resolve().parents[2]
# Seeds: training from 0, its second process from 2^32, validation from 2^40.
UNSEEN_SEED = 1 << 40
SEEDS_A_PROCESS = 1 << 32


class Trainer:
    def __init__(self, args, config):
        self.args, self.config = args, config
        self.rank, self.processes = rank_and_processes()
        self.device = device_of_process()
        torch.manual_seed(config["seed"])
        self.out = Path(args.out)
        (self.out / "samples").mkdir(parents=True, exist_ok=True)
        self.step = self.samples = self.first_seed = self.steps_before = 0
        self.elapsed = self.seconds_before = 0.0
        self.log = []
        self.asked_to_stop = self.stopped = False
        signal.signal(signal.SIGTERM, self.stop)

        self.architecture = files.Architecture.from_json(json.dumps(config["architecture"]))
        model = ZipSplat(self.architecture, config["queries"], config["recompute"])
        state = self.begin(model)
        # Processes draw the same numbers of views.
        self.rng = random.Random(config["seed"] + self.step)
        model.to(self.device)
        average = copy.deepcopy(model).eval().requires_grad_(False) if config["ema"] else model
        if state and config["ema"]:
            average.load_state_dict(state["average"])
        self.model = distribute(model, config["shard"])
        self.average = distribute(average, config["shard"]) if config["ema"] else model
        self.optimizer = Optimizer(self.model, config)
        if state:
            self.optimizer.load_state_dict(state["optimizer"])
        self.objective = Objective(config, losses.Lpips(load_file(args.lpips)).to(self.device) if args.lpips else None)
        if config["compile"]:
            self.compile()
        self.schedule = Schedule(config)

        # Initial weights are equal in all processes, later random numbers differ.
        torch.manual_seed(config["seed"] + self.rank + self.step)

        first_seed = 0 if config["scenes"] else self.first_seed
        self.shards = self.stream(first_seed + self.rank * SEEDS_A_PROCESS, config["scenes"])
        capacity = config["scenes"] or int(config["pool_gb"] * 1e9 / self.shards.record.itemsize)
        self.pool = Pool(self.shards, capacity, self.device, reuse=config["reuse"])
        self.evaluated = self.pool
        if not 0 < config["scenes"] <= SCENES:
            unseen = self.stream(UNSEEN_SEED, SCENES, unseen=True)
            self.evaluated = Pool(unseen, SCENES, self.device)
            self.evaluated.fill(SCENES)
            self.evaluated.close()

    def stream(self, seed, scenes, unseen=False):
        """Opens a stream of `scenes` records (0: endless), generated or from photos."""
        args, size, views = self.args, self.config["size"], self.config["record_views"]
        if args.data:
            sources = [(*source, args.depths) for source in args.data]
            return Captures(sources, record(views, size, size), self.config["gap"], seed, scenes or None, unseen)
        command = generator_command(args.zipsplat, size, views, seed, args.textures, scenes)
        return Shards(command, scenes, open(self.out / "generator.log", "ab"))

    def done(self):
        """Returns the completed fraction of the run."""
        minutes, steps = self.args.minutes, self.args.steps or self.config["steps"]
        return self.elapsed / (60 * minutes) if minutes else self.step / steps

    def stop(self, *_):
        """Ends the run after the current step, then saves."""
        self.asked_to_stop = True

    def begin(self, model):
        """Initializes weights or loads --resume; returns the state of a resumed run."""
        if not self.args.resume:
            initialize(model, self.config["anchor_cells"], **self.config["initial"])
            if self.args.backbone:
                backbone.take_over(model, self.args.backbone)
            return None
        path = Path(self.args.resume)
        if path.is_file():
            architecture, tensors, metadata = files.load(path)
            grows = ("gaussians_per_token", "color_width", "color_heads", "color_hidden", "head_hidden")
            if replace(architecture, **{name: getattr(self.architecture, name) for name in grows}) != self.architecture:
                raise SystemExit(f"{path}: found {architecture}, the configuration expects {self.architecture}")
            if architecture.gaussians_per_token != self.architecture.gaussians_per_token:
                tensors = refine(tensors, architecture, self.architecture.gaussians_per_token)
            if architecture.color_width != self.architecture.color_width:
                tensors = widen_colors(tensors, model, self.config["anchor_cells"])
            model.load_state_dict(tensors)
            before = json.loads(metadata.get("zipsplat.training", "{}"))
            self.steps_before, self.seconds_before = before.get("steps", 0), before.get("seconds", 0.0)
            self.first_seed = before.get("next_seed", 0)
            return None
        state = torch.load(path / "state.pt", map_location="cpu", weights_only=True)
        model.load_state_dict(state["model"])
        for name, value in state["counters"].items():
            setattr(self, name, value)
        self.log = state["log"]
        return state

    def compile(self):
        """Compiles blocks and projection separately: few graphs for all views and ratios."""
        import layers
        import rasterize as drawing

        torch._dynamo.config.recompile_limit = 64
        for kind in (layers.Block, layers.CrossBlock):
            kind.compute = torch.compile(kind.compute, dynamic=True)
        drawing.project = torch.compile(drawing.project, dynamic=True)

    def scenes_of_batch(self, views):
        """Returns the number of scenes of a step in each process."""
        config = self.config
        return max((config["batch_scenes"] or config["batch_views"] // views) // self.processes, 1)

    def sample(self, scenes, views, loose=None):
        return self.pool.sample(scenes, views, self.config["targets"], self.config["spread"], *geometry(self.config), loose)

    def train_step(self):
        done = self.done()
        views, ratio = self.schedule.draw(done, self.rng)
        scenes = self.scenes_of_batch(views)
        draw = self.schedule.draws_pictures(done, self.rng)
        given = torch.rand(scenes, device=self.device) < self.config["priors"]
        # Cameras are only random in steps that do not render.
        loose = None if draw else given & (torch.rand(scenes, device=self.device) < self.config["loose"])
        data = self.sample(scenes, views, loose)
        measured = self.objective.backward(self.model, data, ratio, given, self.schedule.weights(done), draw)
        measured["norm"] = self.optimizer.step(self.schedule.rate(done), self.config["clip"])
        self.synchronize()
        self.step += 1
        self.samples += scenes * self.processes
        decay = min(self.config["ema"], self.step / (10 + self.step))
        if self.config["ema"]:
            with torch.no_grad():
                torch._foreach_lerp_(list(self.average.parameters()), list(self.model.parameters()), 1 - decay)
        return measured

    def synchronize(self):
        """Adopts the first process's clock; stops all if one is asked to."""
        self.elapsed, self.stopped = time.perf_counter() - self.started, self.asked_to_stop
        if self.processes > 1:
            state = torch.tensor([self.elapsed if self.rank == 0 else 0.0, float(self.stopped)], device=self.device)
            dist.all_reduce(state)
            self.elapsed, self.stopped = state[0].item(), state[1].item() > 0

    def warm_up(self):
        """Compiles everything before the clock starts."""
        # A fixed number of scenes is one set in every run.
        self.pool.fill(self.config["scenes"] or min(max(map(self.scenes_of_batch, self.config["views"])), self.pool.capacity))
        for views, ratio in zip(self.config["views"], (1.0, 0.5)):
            data = self.sample(self.objective.at_once(self.scenes_of_batch(views), views), views)
            given = torch.ones(len(data.images), device=self.device) > 0
            self.objective.backward(self.model, data, ratio, given, self.config["losses"])
        self.model.zero_grad(set_to_none=True)
        evaluate(self.objective, self.average, self.evaluated)
        self.pool.waited = 0.0

    def run(self):
        config, end = self.config, self.elapsed + 60 * self.args.stop_after
        self.warm_up()
        print(f"{sum(p.numel() for p in self.model.parameters()) / 1e6:.2f} M parameters, {self.device}, process {self.rank}, "
              f"{self.pool.filled()} scenes to start with, pool of {self.pool.capacity}")  # fmt: skip
        before = self.elapsed
        self.started = time.perf_counter() - before
        saved = logged = before
        measured, first_sample = {}, self.samples
        while self.done() < 1 and self.elapsed < end and not self.stopped:
            step = self.train_step()
            for name, value in step.items() if self.rank == 0 else ():
                measured.setdefault(name, []).append(value)
            if self.rank == 0 and self.step % 10 == 0 and self.elapsed - logged > config["log_seconds"]:
                row = {name: float(torch.stack(values).mean()) for name, values in measured.items()}
                rate = (self.samples - first_sample) / (self.elapsed - logged)
                self.report(row, rate, self.pool.waited / (self.elapsed - before))
                measured, first_sample, logged = {}, self.samples, self.elapsed
            if self.elapsed - saved > 60 * config["save_minutes"]:
                pause = time.perf_counter()
                self.save()
                self.started += time.perf_counter() - pause
                saved = self.elapsed
        self.save()
        self.pool.close()
        if self.processes > 1:
            dist.destroy_process_group()

    def report(self, row, rate, waited):
        row = {
            "step": self.step,
            "seconds": round(self.elapsed, 1),
            "samples": self.samples,
            "samples_per_second": rate,
            "scenes": self.pool.taken,
            "waited": waited,
            "learning_rate": self.schedule.rate(self.done()),
            **row,
        }
        self.log.append(row)
        shown = ("loss", "psnr", "l1", "anchor", "ray", "color", "chamfer", "depth", "reached", "median_scale", "norm")
        print(f"{self.elapsed:6.0f} s  step {self.step}  {rate:.1f} samples/s  waited {waited:.1%}  "
              + "  ".join(f"{name} {row[name]:.3g}" for name in shown if name in row), flush=True)  # fmt: skip

    def save(self):
        """Scores and writes the run; every process takes part."""
        sample = self.out / "samples" / f"{self.step + self.steps_before:07}.png" if self.rank == 0 else None
        scores = attempt(evaluate, self.objective, self.average, self.evaluated, sample)
        model, optimizer = full_state(self.model), self.optimizer.state_dict()
        average = full_state(self.average) if self.config["ema"] else model
        if self.rank > 0:
            return
        print(
            ("learned" if self.evaluated is self.pool else "unseen")
            + " PSNR: "
            + "  ".join(f"{name} {value:.2f}" for name, value in scores.items()),
            flush=True,
        )
        if self.log:
            self.log[-1].update(scores)
        counters = {
            name: getattr(self, name) for name in ("step", "samples", "elapsed", "steps_before", "seconds_before")
        }
        counters["first_seed"] = max(self.first_seed, self.pool.last_seed + 1)
        state = {"model": model, "average": average, "optimizer": optimizer, "counters": counters, "log": self.log}
        torch.save(state, self.out / "state.pt.partial")
        (self.out / "state.pt.partial").replace(self.out / "state.pt")
        device = torch.cuda.get_device_name() if self.device.type == "cuda" else "CPU"
        training = {"steps": self.step + self.steps_before, "samples": self.samples,
                    "seconds": round(self.elapsed + self.seconds_before), "device": device,
                    "next_seed": counters["first_seed"], "unseen_psnr": scores, "config": self.config}  # fmt: skip
        files.save(self.out / "model.safetensors", self.architecture, average, torch.float16,
                   {"zipsplat.training": json.dumps(training), "zipsplat.image_size": str(self.config["size"])})  # fmt: skip
        if self.log:
            names = list(dict.fromkeys(name for row in self.log for name in row))
            with open(self.out / "log.csv", "w", newline="") as file:
                writer = csv.DictWriter(file, names)
                writer.writeheader()
                writer.writerows(self.log)
            attempt(save_curve, self.log, self.out / "curve.png")


def attempt(part, *arguments):
    """Returns the part's result; a failure of diagnostics does not end the run."""
    try:
        return part(*arguments)
    except Exception as error:
        print(f"{part.__name__} failed: {error}", flush=True)
        return {}


def source(text):
    """Parses KIND:FOLDER of a data set."""
    kind, _, folder = text.partition(":")
    if kind not in ("re10k", "dl3dv") or not Path(folder).is_dir():
        raise argparse.ArgumentTypeError(f"found {text}, expected re10k:FOLDER or dl3dv:FOLDER, of a folder that is there")
    return kind, Path(folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True)
    parser.add_argument("--out", help="folder of the run")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=float, help="length of the whole schedule")
    length.add_argument("--steps", type=int, help="length of the whole schedule in steps; default: the setting")
    parser.add_argument(
        "--stop-after", type=float, default=math.inf, help="minutes until this call saves and ends"
    )
    parser.add_argument("--resume", help="folder of a run to continue, or initial weights")
    parser.add_argument("--backbone", help="weights with the initial backbone: ours or Depth Anything 3's")
    parser.add_argument("--zipsplat", default=ROOT / "target/release/zipsplat", help="command that generates scenes")
    parser.add_argument("--data", type=source, action="append", metavar="KIND:FOLDER",
                        help="photos instead of generated scenes: re10k or dl3dv; repeat for a mixture")  # fmt: skip
    parser.add_argument("--depths", type=Path, help="FOLDER/SCENE/NAME.npy or depths.safetensors; default depth/ next to the photos")
    parser.add_argument("--textures", help="folder of photo crops for the generator")
    parser.add_argument("--lpips", help="lpips_vgg.safetensors by tools/lpips.py; enables the perceptual loss")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=JSON", help="changes a setting of the configuration"
    )
    parser.add_argument("--print-settings", action="store_true", help="compares the settings with the paper's and ends")
    parser.add_argument("--plan", action="store_true", help="prints the memory that --gpus need and ends")
    parser.add_argument("--gpus", type=int, default=1, help="number of processes for --plan")
    args = parser.parse_args()
    if not Path(args.config).is_file():
        parser.error(f"--config: found no file {args.config} from {Path.cwd()}; those of the repository lie in {ROOT / 'tools/train'}")
    config = read_config(args.config, args.set)
    if args.print_settings or args.plan:
        print(paper.comparison(config) if args.print_settings else plan.report(config, args.gpus))
        return
    if not args.out:
        parser.error("--out: found none, expected a folder for the run")
    if not (args.minutes or args.steps or config["steps"]):
        parser.error("--minutes, --steps: found none of them, and steps 0 in the settings")
    weights = config["losses"]
    if weights["perceptual"] and not (args.lpips or weights["ssim"] or weights["gradient"]):
        parser.error(f"--lpips: found none, expected a file: losses.perceptual is {weights['perceptual']}, losses.ssim and losses.gradient are 0")
    if not (args.data or shutil.which(args.zipsplat)):
        parser.error(f"--zipsplat: found no program {args.zipsplat}; `cargo build --release` in {ROOT} makes one")
    torch.backends.cudnn.allow_tf32 = True
    torch.backends.cuda.enable_cudnn_sdp(False)  # it re-plans for every shape
    sys.stdout.reconfigure(line_buffering=True)
    Trainer(args, config).run()


if __name__ == "__main__":
    main()
