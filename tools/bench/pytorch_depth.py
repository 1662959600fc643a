"""Times Depth Anything 3 in PyTorch (tools/train/depth.py), for `zipsplat bench depth --pytorch`.

    python pytorch_depth.py ARCHITECTURE WARMUP REPEATS VIEWSxWIDTHxHEIGHT...

ARCHITECTURE is the engine's, as JSON. Prints JSON: device, and per case the milliseconds of each
run of backbone and heads, in f32. Weights are random.
"""

import json
import sys
import time

import torch

from depth import DepthAnything3, architecture_from_json


def timed(work, device):
    """Returns the result of `work` and its milliseconds."""

    def synchronize():
        if device == "cuda":
            torch.cuda.synchronize()

    synchronize()
    started = time.perf_counter()
    made = work()
    synchronize()
    return made, 1e3 * (time.perf_counter() - started)


@torch.inference_mode()
def main():
    architecture, warmup, repeats, *cases = sys.argv[1:]
    warmup, repeats = int(warmup), int(repeats)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with torch.device(device):
        model = DepthAnything3(architecture_from_json(architecture)).eval()
    rows = []
    for case in cases:
        views, width, height = map(int, case.split("x"))
        images = torch.rand(views, 3, height, width, device=device)
        row = {"backbone_ms": [], "heads_ms": []}
        for run in range(warmup + repeats):
            (features, tokens), backbone = timed(lambda: model.features(images), device)
            _, heads = timed(lambda: model.heads(features, tokens, (height, width)), device)
            if run >= warmup:
                row["backbone_ms"].append(backbone)
                row["heads_ms"].append(heads)
        rows.append(row)
    name = torch.cuda.get_device_name() if device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(json.dumps({"device": name, "torch": torch.__version__, "rows": rows}))


if __name__ == "__main__":
    main()
