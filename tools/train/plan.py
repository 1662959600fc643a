"""Memory that a configuration needs, computed without allocating it."""

import json
import weakref

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from data import Batch, record
from layers import Recomputed
from losses import Lpips
from model import ZipSplat
from objective import Objective
from weights import Architecture

GIB = 1 << 30
TILE = 8  # of rasterize_triton
# One for all reports: cached tables belong to it.
FAKE = FakeTensorMode()


class LiveMemory(TorchDispatchMode):
    """Counts the bytes of tensors that operations create, now and at most."""

    def __init__(self):
        super().__init__()
        self.now = self.peak = 0
        self.known = set()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        results = operation(*args, **(kwargs or {}))
        for tensor in tree_leaves(results):
            if isinstance(tensor, torch.Tensor):
                self.add(tensor.untyped_storage())
        return results

    def add(self, storage):
        key = storage._cdata
        if key in self.known:
            return
        size = storage.nbytes()
        self.known.add(key)
        self.now += size
        self.peak = max(self.peak, self.now)
        weakref.finalize(storage, self.remove, key, size)

    def remove(self, key, size):
        self.known.discard(key)
        self.now -= size


class Blend(torch.autograd.Function):
    """The memory of the GPU's renderer: a list of Gaussians for each tile."""

    @staticmethod
    def forward(ctx, splats, bounds, size):
        pictures, count = splats.shape[:2]
        tiles = -(-size[0] // TILE) * -(-size[1] // TILE)
        lists = splats.new_empty(pictures, tiles, count, dtype=torch.int32)
        planes, reached = splats.new_empty(pictures, 5, *size), splats.new_empty(pictures, count, dtype=torch.bool)
        ctx.save_for_backward(splats, lists, planes)
        ctx.mark_non_differentiable(reached)
        return planes, reached

    @staticmethod
    def backward(ctx, *_):
        return torch.zeros_like(ctx.saved_tensors[0]), None, None


def batch_of(config, scenes, views):
    """Returns a batch of scenes of this configuration, all zero."""
    size, targets, patch = config["size"], config["targets"], config["architecture"]["patch"]
    shapes = dict(
        images=(views, 3, size, size), poses=(views, 4, 4), intrinsics=(views, 4), colors=(targets, size, size, 3),
        depth=(targets, size, size), viewmats=(targets, 4, 4), target_intrinsics=(targets, 4),
        points=(config["chamfer_points"], 3), anchors=(views * (size // patch) ** 2, *config["anchor_cells"], 3),
    )  # fmt: skip
    return Batch(*(torch.zeros(scenes, *shapes[name]) for name in Batch._fields))


def backward_memory(config, model, views, blend=Blend.apply):
    """Returns scenes at once and the bytes that their forward and backward pass need.

    Includes neither weights nor gradients. The ratio is 1.
    """
    perceptual = Lpips({name: torch.zeros(shape) for name, shape in Lpips.shapes().items()}) if config["losses"]["perceptual"] else None
    objective = Objective(config, perceptual, blend)
    scenes = objective.at_once(config["batch_scenes"] or config["batch_views"] // views, views)
    data, given = batch_of(config, scenes, views), torch.ones(scenes) > 0
    with LiveMemory() as memory:
        objective.backward(model, data, 1.0, given, config["losses"])
        before = memory.peak = memory.now  # gradients
        objective.backward(model, data, 1.0, given, config["losses"])
    return scenes, memory.peak - before


def report(config, gpus=1):
    """Describes the memory on each of `gpus`."""
    with FAKE:
        model = ZipSplat(Architecture.from_json(json.dumps(config["architecture"])), config["queries"], config["recompute"])
        passes = {views: backward_memory(config, model, views) for views in sorted(set(config["views"]))}
    count = sum(p.numel() for p in model.parameters())
    blocks = [sum(p.numel() for p in m.parameters()) for m in model.modules() if isinstance(m, Recomputed)]
    # FSDP holds two blocks and the parameters outside blocks, with gradients.
    parts = gpus if config["shard"] else 1
    whole = 2 * (2 * max(blocks) + count - sum(blocks)) if parts > 1 else 0
    size, views = config["size"], config["record_views"]
    scene = record(views, size, size).itemsize
    pool = config["scenes"] * scene or config["pool_gb"] * 1e9
    batch = max((config["batch_scenes"] or config["batch_views"] // views) // gpus for views in config["views"])
    pictures = max(config["views"][1] + config["targets"], 1) * 3 * 4 * size**2
    rows = {
        "weights": 4 * count / parts,
        "gradients": 4 * count / parts,
        "optimizer": 8 * count / parts,
        "average of weights": 4 * count / parts if config["ema"] else 0,
        "unsharded weights and gradients": 4 * whole,
        "pool of scenes": pool,
        f"batch of {batch} scenes": batch * (scene + pictures),
    }
    lines = [f"{count:,} parameters; GiB on each of {gpus} GPUs:"]
    lines += [f"{bytes / GIB:8.2f}  {name}" for name, bytes in rows.items() if bytes]
    for views, (scenes, bytes) in passes.items():
        lines.append(f"{bytes / GIB:8.2f}  activations of {scenes} scenes of {views} views, {bytes / scenes / GIB:.2f} a scene")
    most = max(bytes for _, bytes in passes.values())
    return "\n".join([*lines, f"{(sum(rows.values()) + most) / GIB:8.2f}  in all"])
