"""Procedural scenes from the generator (`zipsplat scene --shards`), pooled on the device."""

import queue
import subprocess
import threading
import time
from collections import namedtuple
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F

MAGIC, FORMAT = b"ZSSCENES", 1
HEADER = np.dtype([("magic", "S8"), ("format", "<u4"), ("generator", "<u4"), ("scenes", "<u8"), ("vhw", "<u4", 3)])

# B scenes of V context and C target views, in the frame of the first context view, with unit median
# distance: images [B, V, 3, H, W] 0..1, poses [B, V, 4, 4] camera to world, intrinsics [B, V, 4] fx
# fy cx cy; colors [B, C, H, W, 3] 0..1, depth [B, C, H, W] (0: sky), viewmats, target_intrinsics:
# targets; points [B, M, 3]: visible surface points; anchors [B, V * T, rows, columns, 3]: surface
# points at the centers of each patch's cells.
Batch = namedtuple("Batch", "images poses intrinsics colors depth viewmats target_intrinsics points anchors")

# Distance of the sky in anchors, and the largest one, in median distances.
SKY = 12.0


def record(views, height, width):
    """Returns the NumPy type of a scene in the stream."""
    return np.dtype(
        [("seed", "<u8"), ("family", "<u4"), ("path", "<u4"), ("intrinsics", "<f4", (views, 4)),
         ("poses", "<f4", (views, 3, 4)), ("overlap", "<f4", (views, views)), ("colors", "u1", (views, height, width, 3)),
         ("depths", "<f2", (views, height, width))]
    )  # fmt: skip


class Shards:
    """A stream of records in the layout of tools/src/procedural/shards.rs; endless for 0 scenes."""

    def __init__(self, command, scenes=0, log=subprocess.DEVNULL):
        self.scenes = scenes
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log)
        header = np.frombuffer(self.process.stdout.read(HEADER.itemsize), HEADER)
        if len(header) == 0 or (header["magic"][0], header["format"][0]) != (MAGIC, FORMAT):
            raise RuntimeError(f"{' '.join(command)}: found {header}, expected a stream of scenes of format {FORMAT}")
        self.record = record(*header["vhw"][0].tolist())

    def read_into(self, buffer):
        """Fills a byte array with records; returns their number."""
        view, filled = memoryview(buffer), 0
        while filled < len(view) and (count := self.process.stdout.readinto(view[filled:])):
            filled += count
        if filled < len(view) and not self.scenes:
            raise RuntimeError(f"{' '.join(self.process.args)}: the stream of scenes ended")
        return filled // self.record.itemsize

    def close(self):
        self.process.kill()
        self.process.wait()


def generator_command(zipsplat, size, views, first_seed, textures=None, scenes=None):
    # Training has priority on the CPU: the pool already holds scenes.
    command = ["nice", "-n", "5", str(zipsplat), "scene", "--shards", "-", "--views", str(views), "--size", f"{size}x{size}"]
    command += ["--first-seed", str(first_seed)]
    command += ["--textures", textures] if textures else []
    return command + (["--scenes", str(scenes)] if scenes else [])


class Pool:
    """Scenes on the device; a thread reads new ones, `sample` draws and replaces the oldest.

    A full pool accepts one scene per `reuse` draws, so that the generator leaves the CPU to
    training; 0 accepts all. `waited` counts seconds that training waited for scenes.
    """

    FIELDS = ("intrinsics", "poses", "overlap", "colors", "depths")
    KINDS = {"u1": torch.uint8, "f2": torch.float16, "f4": torch.float32}

    def __init__(self, shards, capacity, device, block=32, reuse=0.0):
        self.shards, self.capacity, self.device, self.reuse = shards, capacity, torch.device(device), reuse
        self.block = min(block, capacity)
        self.taken = self.drawn = self.last_seed = 0
        self.waited = 0.0
        self.rows = self.columns(capacity, device=self.device)
        self.ready, self.free = queue.Queue(), queue.Queue()
        for _ in range(64 if self.device.type == "cuda" else 4):
            self.free.put((self.columns(self.block, pin_memory=self.device.type == "cuda"), None))
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def columns(self, count, **options):
        fields = ((name, *self.shards.record[name].subdtype) for name in self.FIELDS)
        return {name: torch.empty(count, *shape, dtype=self.KINDS[t.str[1:]], **options) for name, t, shape in fields}

    def read(self):
        buffer = np.empty(self.block, self.shards.record)
        count = self.block
        while count == self.block:
            columns, copied = self.free.get()
            if columns is None:
                return
            if copied is not None:
                copied.synchronize()
            try:
                count = self.shards.read_into(buffer.view(np.uint8))
            except Exception as error:  # forwarded to the waiting thread
                self.ready.put((None, error, 0))
                return
            for name, column in columns.items():
                column.numpy()[:] = buffer[name]
            self.ready.put((columns, count, int(buffer["seed"][count - 1])))

    def take_in(self, wait=False):
        """Overwrites the oldest scenes by one block if it is ready; returns the number."""
        try:
            columns, count, seed = self.ready.get(timeout=60) if wait else self.ready.get_nowait()
        except queue.Empty:
            return 0
        if columns is None:
            raise count
        start = self.taken % self.capacity
        fits = min(count, self.capacity - start)
        for name, column in columns.items():
            self.rows[name][start : start + fits].copy_(column[:fits], non_blocking=True)
            self.rows[name][: count - fits].copy_(column[fits:count], non_blocking=True)
        copied = None
        if self.device.type == "cuda":
            copied = torch.cuda.Event()
            copied.record()
        self.taken += count
        self.last_seed = seed if count else self.last_seed
        self.free.put((columns, copied))
        return count

    def close(self):
        """Ends the stream and its thread: PyTorch aborts threads that outlive the interpreter."""
        self.shards.close()
        self.free.put((None, None))
        self.reader.join()

    def filled(self):
        return min(self.taken, self.capacity)

    def fill(self, count):
        """Waits for `count` scenes."""
        while self.filled() < min(count, self.capacity):
            started = time.perf_counter()
            if not self.take_in(wait=True):
                raise RuntimeError(f"found {self.taken} scenes in the stream or a minute without one, expected {count}")
            self.waited += time.perf_counter() - started

    def sample(self, scenes, views, targets, spread, points, cells, patch, loose=None):
        self.fill(self.block)
        while self.taken < self.capacity or self.drawn >= self.reuse * (self.taken - self.capacity):
            if self.take_in() == 0:
                break
        self.drawn += scenes
        chosen = torch.randint(self.filled(), (scenes,), device=self.device)
        return batch(*self.split(chosen, views, targets, spread), points, cells, patch, loose)

    def split(self, chosen, views, targets, spread):
        """Returns rows and random context [B, V] and target [B, C] views of each.

        With probability `spread` the context is a farthest-point sample, as in `eval` on captures.
        Otherwise views that overlap the first are likelier. Targets favor views that two context
        views cover.
        """
        rows = {name: value[chosen] for name, value in self.rows.items()}
        overlap = rows["overlap"]
        key = torch.rand(overlap.shape[:2], device=self.device)
        first = key.argmax(1)
        key += overlap.gather(2, first[:, None, None].expand(-1, overlap.shape[1], 1))[..., 0]
        key.scatter_(1, first[:, None], 9.0)
        context = key.argsort(1, descending=True)[:, :views]
        apart = torch.rand(len(chosen), 1, device=self.device) < spread
        context = torch.where(apart, farthest(rows["poses"][..., 3], first, views), context)
        seen = overlap.gather(2, context[:, None].expand(-1, overlap.shape[1], -1))
        cover = seen.topk(min(2, views), 2).values.mean(2)
        key = (torch.rand_like(cover) + 2 * cover).scatter(1, context, -9.0)
        return rows, context, key.argsort(1, descending=True)[:, :targets]


def farthest(positions, first, count):
    """Farthest-point sampling of [B, V, 3] from `first` [B]: indices [B, count]."""
    chosen = [first]
    distance = torch.full(positions.shape[:2], torch.inf, device=positions.device)
    while len(chosen) < count:
        last = pick(positions, chosen[-1][:, None])
        distance = distance.minimum((positions - last).norm(dim=-1))
        chosen.append(distance.argmax(1))
    return torch.stack(chosen, 1)


def fixed_split(rows, views, targets):
    """Evenly spaced context views with targets between them, for evaluation."""
    count, device = rows["poses"].shape[1], rows["poses"].device
    context = torch.linspace(0, count - 1, views, device=device).round().long()
    others = torch.tensor([i for i in range(count) if i not in context.tolist()], device=device)
    others = others[torch.linspace(0, len(others) - 1, targets, device=device).round().long()]
    scenes = len(rows["poses"])
    return rows, context.expand(scenes, -1), others.expand(scenes, -1)


def pick(values, index):
    """values [B, V, ...] at index [B, K] -> [B, K, ...]"""
    return values[torch.arange(len(values), device=values.device)[:, None], index]


def inverse(poses):
    """Inverts rigid motions [..., 4, 4]."""
    rotation = poses[..., :3, :3].mT
    result = poses.clone()
    result[..., :3, :3] = rotation
    result[..., :3, 3:] = -rotation @ poses[..., :3, 3:]
    return result


def batch(rows, context, targets, points, cells, patch, loose=None):
    """Moves scenes into the frame of their first context view and scales to unit median distance.

    In `loose` [B] scenes the other cameras get random poses, independent of the pictures.
    """
    poses = torch.eye(4, device=context.device).repeat(*rows["poses"].shape[:2], 1, 1)
    poses[:, :, :3] = rows["poses"]
    relative = inverse(pick(poses, context[:, :1])) @ poses
    depth, intrinsics = pick(rows["depths"], context).float(), pick(rows["intrinsics"], context)
    index = torch.randint(depth[0].numel(), (len(depth), points), device=depth.device)
    cloud = unproject(depth, intrinsics, pick(relative, context), index)
    scale = cloud.norm(dim=-1).nanmedian(1).values.nan_to_num(1.0).clamp_min(1e-3)[:, None, None]
    relative[..., :3, 3] /= scale
    cloud = cloud / scale
    cameras = pick(relative, context)
    if loose is not None:
        cameras[:, 1:] = torch.where(loose[:, None, None, None], anywhere(cameras[:, 1:]), cameras[:, 1:])
    # Sky pixels repeat a surface point to keep shapes fixed.
    seen = cloud.isfinite().all(-1)
    cloud = torch.where(seen[..., None], cloud, pick(cloud, seen.float().argmax(1)[:, None]).nan_to_num(1.0))

    centers = cell_centers(*depth.shape[1:], *cells, patch, depth.device)
    bounded = torch.where(depth > 0, depth / scale[..., None], SKY).clamp_max(SKY)
    return Batch(
        pick(rows["colors"], context).movedim(-1, 2).float() / 255,
        cameras,
        intrinsics,
        pick(rows["colors"], targets).float() / 255,
        pick(rows["depths"], targets).float() / scale[..., None],
        inverse(pick(relative, targets)),
        pick(rows["intrinsics"], targets),
        cloud,
        unproject(bounded, intrinsics, cameras, centers.expand(len(depth), -1)).unflatten(1, (-1, *cells)),
    )


def anywhere(poses):
    """Returns random poses of the same shape: any rotation, a few median distances away."""
    axis = torch.randn_like(poses[..., :3, 3])
    # Mostly around the vertical, like a walking photographer.
    axis = F.normalize(axis * axis.new_tensor((0.4, 1.0, 0.4)), dim=-1)
    angle = torch.pi * torch.rand_like(axis[..., :1])
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
    angle = angle[..., None]
    turn = angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)  # Rodrigues minus the identity
    result = torch.eye(4, device=poses.device).expand_as(poses).clone()
    result[..., :3, :3] += turn
    result[..., :3, 3] = torch.randn_like(axis) * 2 * torch.rand_like(axis[..., :1])
    return result


@cache
def cell_centers(views, height, width, rows, columns, patch, device):
    """Pixel indices [V * T * cells] of the cell centers of all patches, patch by patch."""
    pixels = torch.arange(views * height * width).view(views, height // patch, patch, width // patch, patch)
    y, x = (((torch.arange(count) + 0.5) * patch / count).long() for count in (rows, columns))
    return pixels[:, :, y][..., x].permute(0, 1, 3, 2, 4).flatten().to(device)


def unproject(depth, intrinsics, poses, index):
    """World points [B, M, 3] of pixels `index` [B, M] into depth [B, V, H, W]; NaN in the sky."""
    h, w = depth.shape[2:]
    view, pixel = index // (h * w), index % (h * w)
    z = depth.flatten(1).gather(1, index)
    fx, fy, cx, cy = pick(intrinsics, view).unbind(-1)
    x, y = (pixel % w + 0.5 - cx) / fx, (pixel // w + 0.5 - cy) / fy
    pose = pick(poses, view)
    world = (pose[..., :3, :3] @ torch.stack((x * z, y * z, z), -1)[..., None])[..., 0] + pose[..., :3, 3]
    return torch.where(z[..., None] > 0, world, torch.nan)
