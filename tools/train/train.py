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

import numpy as np
import torch
import torch.distributed as dist
from PIL import Image

import backbone
import losses
import weights as files
from captures import Captures
from data import Pool, Shards, batch, fixed_split, generator_command, record
from grow import refine, widen_colors
from initialize import initialize
from model import ZipSplat
from optimizer import Optimizer
from rasterize import rasterize
from schedule import Schedule, read_config

ROOT = Path(__file__).resolve().parents[2]
# Seeds: training from 0, its second process from 2^36, validation from 2^40.
UNSEEN_SEED = 1 << 40
SEEDS_A_PROCESS = 1 << 36
UNSEEN_SCENES = 16


class Trainer:
    def __init__(self, args, config):
        self.args, self.config = args, config
        self.rank, self.processes = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if torch.cuda.is_available() else torch.device("cpu")
        if self.processes > 1:
            dist.init_process_group("nccl" if self.device.type == "cuda" else "gloo")
        torch.manual_seed(config["seed"])
        self.rng = random.Random(config["seed"] + self.rank)
        self.out = Path(args.out)
        (self.out / "samples").mkdir(parents=True, exist_ok=True)
        self.step = self.samples = self.first_seed = self.steps_before = 0
        self.elapsed = self.seconds_before = 0.0
        self.log = []
        self.stopped = False
        signal.signal(signal.SIGTERM, self.stop)

        self.architecture = files.Architecture.from_json(json.dumps(config["architecture"]))
        model = ZipSplat(self.architecture, config["queries"])
        state = self.begin(model)
        self.model = model.to(self.device)
        self.average = copy.deepcopy(self.model).eval().requires_grad_(False)
        self.optimizer = Optimizer(self.model, config["weight_decay"], self.rank, self.processes, config["backbone_rate"], config["muon"])
        if state:
            self.average.load_state_dict(state["average"])
            self.optimizer.load_state_dict(state["optimizer"])
        self.perceptual = losses.Lpips(args.lpips).to(self.device) if args.lpips else None
        self.autocast = torch.bfloat16 if config["bf16"] else None
        if config["compile"]:
            self.compile()
        self.schedule = Schedule(config)

        # The initial weights are the same in all processes, later random numbers differ.
        torch.manual_seed(config["seed"] + self.rank)

        self.shards = self.stream(self.first_seed + self.rank * SEEDS_A_PROCESS, config["scenes"])
        capacity = config["scenes"] or int(config["pool_gb"] * 1e9 / self.processes / self.shards.record.itemsize)
        self.pool = Pool(self.shards, capacity, self.device, reuse=config["reuse"])
        self.evaluated = self.pool
        if not 0 < config["scenes"] <= UNSEEN_SCENES:
            unseen = self.stream(UNSEEN_SEED, UNSEEN_SCENES, unseen=True)
            self.evaluated = Pool(unseen, UNSEEN_SCENES, self.device)
            self.evaluated.fill(UNSEEN_SCENES)
            unseen.close()

    def stream(self, seed, scenes, unseen=False):
        """Opens a stream of `scenes` records (0: endless), generated or from photos."""
        args, size, views = self.args, self.config["size"], self.config["record_views"]
        if args.data:
            sources = [(*source, args.depths) for source in args.data]
            return Captures(sources, record(views, size, size), self.config["gap"], seed, scenes or None, unseen)
        command = generator_command(args.zipsplat, size, views, seed, args.textures, scenes)
        return Shards(command, open(self.out / "generator.log", "ab"))

    def done(self):
        """Returns the completed fraction of the run."""
        return self.step / self.args.steps if self.args.steps else self.elapsed / (60 * self.args.minutes)

    def stop(self, *_):
        """Ends the run after the current step, then saves."""
        self.stopped = True

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
            kind.forward = torch.compile(kind.forward, dynamic=True)
        drawing.project = torch.compile(drawing.project, dynamic=True)

    def forward(self, model, given_batch, ratio, given, draw=True):
        priors = (given_batch.poses, given_batch.intrinsics)
        with torch.autocast(self.device.type, self.autocast, enabled=self.autocast is not None):
            gaussians, tokens = model(given_batch.images, ratio, priors, given)
        if not draw:
            return gaussians, tokens, None
        size = given_batch.colors.shape[2:4]
        pictures = rasterize(
            gaussians, given_batch.viewmats, given_batch.target_intrinsics, size, self.architecture.sh_degree
        )
        return gaussians, tokens, pictures

    def geometry(self):
        return self.config["chamfer_points"], self.config["anchor_cells"], self.architecture.patch

    def train_step(self):
        done = self.done()
        views, ratio = self.schedule.draw(done, self.rng)
        scenes = max(self.config["batch_views"] // self.processes // views, 1)
        draw = self.schedule.draws_pictures(done, self.rng)
        given = torch.rand(scenes, device=self.device) < self.config["priors"]
        # Cameras are only random in steps that do not render.
        loose = None if draw else given & (torch.rand(scenes, device=self.device) < self.config["loose"])
        data = self.pool.sample(scenes, views, self.config["targets"], self.config["spread"], *self.geometry(), loose)
        gaussians, tokens, pictures = self.forward(self.model, data, ratio, given, draw)
        weights = self.schedule.weights(done)
        sample = self.config["chamfer_gaussians"]
        loss, parts = losses.total(gaussians, tokens, pictures, given, data, weights, sample, self.perceptual)
        loss.backward()
        self.share_gradients()
        norm = self.optimizer.step(self.schedule.rate(done), self.config["clip"])
        self.step += 1
        self.samples += scenes * self.processes
        decay = min(self.config["ema"], self.step / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.model.parameters()), 1 - decay)
        with torch.no_grad():
            parts |= {"loss": loss, "norm": norm, "median_scale": gaussians[:, ::7, 3:6].median()}
            if draw:
                error = (pictures.rgb.clamp(0, 1) - data.colors).square().mean((1, 2, 3, 4))
                parts |= {"psnr": -10 * error.log10().mean(), "reached": pictures.reached.float().mean()}
            return {name: value.detach() for name, value in parts.items()}

    def share_gradients(self):
        """Averages gradients, adopts the first process's clock, stops all if one stops."""
        now = time.perf_counter() - self.started
        if self.processes == 1:
            self.elapsed = now
            return
        gradients = [parameter.grad for parameter in self.model.parameters()]
        clock = torch.tensor([now if self.rank == 0 else 0.0, float(self.stopped)], device=self.device)
        flat = torch.cat([gradient.flatten() for gradient in gradients] + [clock])
        dist.all_reduce(flat)
        self.elapsed, self.stopped = flat[-2].item(), flat[-1].item() > 0
        for gradient, mean in zip(gradients, (flat[:-2] / self.processes).split([g.numel() for g in gradients])):
            gradient.copy_(mean.view_as(gradient))

    def warm_up(self):
        """Compiles everything before the clock starts."""
        # A fixed number of scenes is the same set in every run.
        self.pool.fill(self.config["scenes"] or min(self.config["batch_views"], self.pool.capacity))
        for views, ratio in zip(self.config["views"], (1.0, 0.5)):
            scenes = max(self.config["batch_views"] // views, 1)
            data = self.pool.sample(scenes, views, self.config["targets"], self.config["spread"], *self.geometry())
            given = torch.ones(len(data.images), device=self.device) > 0
            gaussians, tokens, pictures = self.forward(self.model, data, ratio, given)
            weights = self.config["losses"]
            losses.total(gaussians, tokens, pictures, given, data, weights, 64, self.perceptual)[0].backward()
        self.model.zero_grad(set_to_none=True)
        self.evaluate()
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
            for name, value in self.train_step().items():
                measured.setdefault(name, []).append(value)
            if self.rank > 0:
                continue
            if self.step % 10 == 0 and self.elapsed - logged > config["log_seconds"]:
                row = {name: float(torch.stack(values).mean()) for name, values in measured.items()}
                rate = (self.samples - first_sample) / (self.elapsed - logged)
                self.report(row, rate, self.pool.waited / (self.elapsed - before))
                measured, first_sample, logged = {}, self.samples, self.elapsed
            if self.elapsed - saved > 60 * config["save_minutes"]:
                pause = time.perf_counter()
                self.save()
                self.started += time.perf_counter() - pause
                saved = self.elapsed
        if self.rank == 0:
            self.save()
        self.shards.close()

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

    @torch.no_grad()
    @torch.compiler.set_stance("force_eager")  # compiling evaluation would take minutes
    def evaluate(self):
        """Returns the PSNR of averaged weights on validation scenes (or few fixed ones)."""
        views, targets = self.config["evaluate"]
        count = min(UNSEEN_SCENES, self.evaluated.filled())
        size = 8
        scores, grid = {}, []
        with torch.random.fork_rng(devices=[self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(0)
            rows = {name: value[:count] for name, value in self.evaluated.rows.items()}
            data = batch(*fixed_split(rows, views, targets), *self.geometry())
        for given in (True, False):
            for ratio in (1.0, 0.5):
                psnr = []
                for start in range(0, count, size):
                    part = type(data)(*(value[start : start + size] for value in data))
                    given_scenes = torch.full((len(part.images),), given, device=self.device)
                    _, _, pictures = self.forward(self.average, part, ratio, given_scenes)
                    rgb = pictures.rgb.clamp(0, 1)
                    psnr.append(-10 * (rgb - part.colors).square().mean((2, 3, 4)).log10().flatten())
                    if ratio == 1 and start == 0:
                        grid.append((rgb, pictures.depth))
                scores[f"{'priors' if given else 'plain'}_r{ratio:g}"] = torch.cat(psnr).mean().item()
        self.picture(data, grid)
        return scores

    def picture(self, data, grid):
        """Saves rows: two inputs; two targets as truth, with and without priors, depth."""
        (given, depth), (plain, _) = grid
        nearness = (1 / (1 + depth))[..., None].expand_as(given)
        lines = []
        for i in range(min(6, len(given))):
            tiles = [data.images[i, 0].movedim(0, -1), data.images[i, -1].movedim(0, -1)]
            for t in range(min(2, given.shape[1])):
                tiles += [data.colors[i, t], given[i, t], plain[i, t], nearness[i, t]]
            lines.append(torch.cat(tiles, 1))
        if self.rank > 0:
            return
        pixels = (torch.cat(lines).float().clamp(0, 1) * 255).byte().cpu().numpy()
        Image.fromarray(pixels).save(self.out / "samples" / f"{self.step + self.steps_before:07}.png")

    def attempt(self, part):
        """Returns the part's result; a failure of diagnostics does not end the run."""
        try:
            return part()
        except Exception as error:
            print(f"{part.__name__} failed: {error}", flush=True)
            return {}

    def save(self):
        scores = self.attempt(self.evaluate)
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
        state = {"model": self.model.state_dict(), "average": self.average.state_dict(),
                 "optimizer": self.optimizer.state_dict(), "counters": counters, "log": self.log}  # fmt: skip
        torch.save(state, self.out / "state.pt.partial")
        (self.out / "state.pt.partial").replace(self.out / "state.pt")
        device = torch.cuda.get_device_name() if self.device.type == "cuda" else "CPU"
        training = {"steps": self.step + self.steps_before, "samples": self.samples,
                    "seconds": round(self.elapsed + self.seconds_before), "device": device,
                    "next_seed": counters["first_seed"], "unseen_psnr": scores, "config": self.config}  # fmt: skip
        files.save(self.out / "model.safetensors", self.architecture, self.average.state_dict(), torch.float16,
                   {"zipsplat.training": json.dumps(training), "zipsplat.image_size": str(self.config["size"])})  # fmt: skip
        if self.log:
            names = list(dict.fromkeys(name for row in self.log for name in row))
            with open(self.out / "log.csv", "w", newline="") as file:
                writer = csv.DictWriter(file, names)
                writer.writeheader()
                writer.writerows(self.log)
            self.attempt(self.curve)

    def curve(self):
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        figure, axes = pyplot.subplots(1, 2, figsize=(11, 4))
        minutes = np.array([row["seconds"] for row in self.log]) / 60
        axes[0].plot(minutes, [row["loss"] for row in self.log])
        axes[0].set(xlabel="minutes", ylabel="loss", yscale="log")
        axes[1].plot(minutes, [row.get("psnr", math.nan) for row in self.log], color="0.7", label="training")
        for name in ("priors_r1", "priors_r0.5", "plain_r1", "plain_r0.5"):
            scored = [(t, row[name]) for t, row in zip(minutes, self.log) if name in row]
            if scored:
                axes[1].plot(*zip(*scored), marker=".", label=f"unseen, {name}")
        axes[1].set(xlabel="minutes", ylabel="PSNR, dB")
        axes[1].legend()
        figure.tight_layout()
        figure.savefig(self.out / "curve.png", dpi=110)
        pyplot.close(figure)


def source(text):
    """Parses KIND:FOLDER of a data set."""
    kind, _, folder = text.partition(":")
    if kind not in ("re10k", "dl3dv") or not Path(folder).is_dir():
        raise argparse.ArgumentTypeError(f"found {text}, expected re10k:FOLDER or dl3dv:FOLDER, of a folder that is there")
    return kind, Path(folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", required=True)
    parser.add_argument("--out", required=True)
    length = parser.add_mutually_exclusive_group(required=True)
    length.add_argument("--minutes", type=float, help="length of the whole schedule")
    length.add_argument("--steps", type=int, help="length of the whole schedule in steps")
    parser.add_argument(
        "--stop-after", type=float, default=math.inf, help="minutes until this call saves and ends"
    )
    parser.add_argument("--resume", help="folder of a run to continue, or initial weights")
    parser.add_argument("--backbone", help="weights with the initial backbone: ours or Depth Anything 3's")
    parser.add_argument("--zipsplat", default=ROOT / "target/release/zipsplat", help="command that generates scenes")
    parser.add_argument("--data", type=source, action="append", metavar="KIND:FOLDER",
                        help="photos instead of generated scenes: re10k or dl3dv; repeat for a mixture")  # fmt: skip
    parser.add_argument("--depths", type=Path, help="FOLDER/SCENE/NAME.npy for --data; default depth/ next to the photos")
    parser.add_argument("--textures", help="folder of photo crops for the generator")
    parser.add_argument("--lpips", help="lpips_vgg.safetensors by tools/lpips.py; enables the perceptual loss")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=JSON", help="changes a setting of the configuration"
    )
    args = parser.parse_args()
    if not (args.data or shutil.which(args.zipsplat)):
        parser.error(f"--zipsplat: found no program {args.zipsplat}; `cargo build --release` in {ROOT} makes one")
    if not Path(args.config).is_file():
        parser.error(f"--config: found no file {args.config} from {Path.cwd()}; those of the repository lie in {ROOT / 'tools/train'}")
    torch.backends.cudnn.allow_tf32 = True
    torch.backends.cuda.enable_cudnn_sdp(False)  # it re-plans for every shape
    sys.stdout.reconfigure(line_buffering=True)
    Trainer(args, read_config(args.config, args.set)).run()


if __name__ == "__main__":
    main()
