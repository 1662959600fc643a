"""Times of work in PyTorch."""

import json
import time

import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def synchronize():
    if DEVICE == "cuda":
        torch.cuda.synchronize()


def timed(work):
    """Returns the result of `work` and its milliseconds."""
    synchronize()
    started = time.perf_counter()
    result = work()
    synchronize()
    return result, 1e3 * (time.perf_counter() - started)


def measure(work, warmup, repeats):
    return [timed(work)[1] for _ in range(warmup + repeats)][warmup:]


def report(rows):
    name = torch.cuda.get_device_name() if DEVICE == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(json.dumps({"device": name, "torch": torch.__version__, "rows": rows}))
