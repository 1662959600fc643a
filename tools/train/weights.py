"""Architecture, weight files (safetensors, as in the engine) and seeded weights."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

ARCHITECTURE_KEY = "zipsplat.architecture"

# Seeded matrices of double amplitude.
HEADS = ("gaussian_head.gaussian_head.1.weight", "model.head.", "model.cam_dec.")


@dataclass(frozen=True)
class Architecture:
    """Fields as documented in the engine's `zipsplat::weights::Architecture`."""

    name: str
    width: int
    depth: int
    heads: int
    ffn: str
    ffn_hidden: int
    patch: int
    position_grid: int
    alt_start: int
    qk_norm_start: int
    rope_start: int
    out_layers: tuple[int, ...]
    camera_depth: int
    camera_heads: int
    camera_hidden: int
    camera_pose_hidden: int
    fusion_heads: int
    fusion_hidden: int
    color_width: int
    color_heads: int
    color_hidden: int
    head_hidden: int
    gaussians_per_token: int
    sh_degree: int
    family: str = "da3"

    @staticmethod
    def from_json(text):
        fields = json.loads(text)
        return Architecture(**{**fields, "out_layers": tuple(fields["out_layers"])})

    def to_json(self):
        fields = {**asdict(self), "out_layers": list(self.out_layers)}
        if self.family == "da3":
            del fields["family"]
        return json.dumps(fields, separators=(",", ":"))

    def is_global(self, block):
        return block >= self.alt_start and block % 2 == 1

    @property
    def gaussian_width(self):
        return 11 + 3 * (self.sh_degree + 1) ** 2


def save(path, architecture, tensors, dtype=torch.float16, metadata=None):
    """Writes weights for the engine; `metadata` adds strings to the header."""
    tensors = {name: tensor.detach().cpu().to(dtype).contiguous() for name, tensor in tensors.items()}
    if bad := [name for name, tensor in tensors.items() if not torch.isfinite(tensor).all()]:
        raise ValueError(f"{path}: {bad} hold values that {dtype} does not, or NaN")
    partial = Path(f"{path}.partial")
    save_file(tensors, partial, {**(metadata or {}), ARCHITECTURE_KEY: architecture.to_json()})
    partial.replace(path)


def load(path):
    """Returns (architecture, {name: f32 tensor}, metadata) of a file."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
        if ARCHITECTURE_KEY not in metadata:
            raise ValueError(f"{path}: found no {ARCHITECTURE_KEY} in the metadata, expected the engine's safetensors")
        tensors = {name: file.get_tensor(name).float() for name in file.keys()}
    return Architecture.from_json(metadata[ARCHITECTURE_KEY]), tensors, metadata


def seeded(key, name, shape):
    """A parameter of `seeded:` weights: splitmix64, seeded by the FNV-1a hash of its name."""

    seed = 0xCBF29CE484222325
    for byte in f"{key}/{name}".encode():
        seed = ((seed ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    count = int(np.prod(shape))
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    byte = ((z ^ (z >> np.uint64(31))) >> np.uint64(56)).astype(np.int64)
    centered = (2 * byte - 255) / 256
    last = name.rsplit(".", 1)[-1]
    if last == "gamma":
        values = (52 + ((byte * 204) >> 8)) / 256
    elif last.endswith(("token", "tokens")):
        values = centered
    elif last == "pos_embed":
        values = centered / 2
    elif last == "bias":
        values = centered / 8 + name.endswith("fc_fov.0.bias")
    elif len(shape) == 1:
        values = (64 + (byte >> 1)) / 128
    else:
        spread = name.endswith(("resize_layers.0.weight", "resize_layers.1.weight"))
        fan_in = shape[0] if spread else int(np.prod(shape[1:]))
        halvings = next(e for e in range(31) if 3 * 4**e >= fan_in)
        in_head = name.startswith(HEADS) and ".refinenet" not in name
        values = centered * 2.0 ** -(halvings - in_head)
    return torch.from_numpy(values.reshape(shape))
