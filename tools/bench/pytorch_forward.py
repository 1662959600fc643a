"""Times the forward pass in PyTorch (tools/train/model.py), for `zipsplat bench forward --pytorch`.

    python pytorch_forward.py ARCHITECTURE WARMUP REPEATS WIDTHxHEIGHT VIEWS:RATIO...

ARCHITECTURE is the engine's, as JSON. Prints JSON: per number of views, ratio and precision the milliseconds of each run and, on GPUs, the
peak memory in bytes. Weights are random.
"""

import gc
import sys

import torch

import model as network
from timing import DEVICE, measure, report
from weights import Architecture


# Autocast type, TensorFloat-32, torch.compile.
PRECISIONS = {
    "f32": (None, False, False),
    "tf32": (None, True, False),
    "bf16": (torch.bfloat16, True, False),
    "bf16-compiled": (torch.bfloat16, True, True),
}


@torch.inference_mode()
def main():
    architecture, warmup, repeats, size, *cases = sys.argv[1:]
    warmup, repeats = int(warmup), int(repeats)
    width, height = map(int, size.split("x"))
    with torch.device(DEVICE):  # on a GPU for speed
        model = network.ZipSplat(Architecture.from_json(architecture)).eval()
    rows = []
    for name in PRECISIONS if DEVICE == "cuda" else ("f32", "bf16"):
        autocast, tf32, compiled = PRECISIONS[name]
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = tf32
        if compiled:
            # By block, as in training: the whole model would recompile for every number of views.
            for kind in (network.Block, network.CrossBlock):
                kind.forward = torch.compile(kind.forward, dynamic=True)
        for case in cases:
            views, ratio = case.split(":")
            views, ratio = int(views), float(ratio)
            images = torch.rand(1, views, 3, height, width, device=DEVICE)
            if DEVICE == "cuda":
                gc.collect()
                torch.cuda.empty_cache()
                torch.cuda.reset_peak_memory_stats()

            def forward():
                with torch.autocast(DEVICE, autocast, enabled=autocast is not None):
                    model(images, ratio)

            row = {"precision": name, "views": views, "ratio": ratio}
            try:
                row["ms"] = measure(forward, warmup, repeats)
                row["peak_bytes"] = torch.cuda.max_memory_allocated() if DEVICE == "cuda" else None
            except torch.cuda.OutOfMemoryError:
                row["failed"] = "out of memory"
            except Exception as error:  # a compiler failure only costs its rows
                row["failed"] = f"{type(error).__name__}: {error}".splitlines()[0]
            rows.append(row)
    report(rows)


if __name__ == "__main__":
    main()
