"""Times Depth Anything 3 in PyTorch (tools/train/depth.py), for `zipsplat bench depth --pytorch`.

    python pytorch_depth.py ARCHITECTURE WARMUP REPEATS VIEWSxWIDTHxHEIGHT...

ARCHITECTURE is the engine's, as JSON. Prints JSON: device, and per case the milliseconds of each
run of backbone and heads, in f32. Weights are random.
"""

import sys

import torch

from depth import DepthAnything3, architecture_from_json
from timing import DEVICE, report, timed


@torch.inference_mode()
def main():
    architecture, warmup, repeats, *cases = sys.argv[1:]
    warmup, repeats = int(warmup), int(repeats)
    with torch.device(DEVICE):
        model = DepthAnything3(architecture_from_json(architecture)).eval()
    rows = []
    for case in cases:
        views, width, height = map(int, case.split("x"))
        images = torch.rand(views, 3, height, width, device=DEVICE)
        row = {"backbone_ms": [], "heads_ms": []}
        for run in range(warmup + repeats):
            (features, tokens), backbone = timed(lambda: model.features(images))
            _, heads = timed(lambda: model.heads(features, tokens, (height, width)))
            if run >= warmup:
                row["backbone_ms"].append(backbone)
                row["heads_ms"].append(heads)
        rows.append(row)
    report(rows)


if __name__ == "__main__":
    main()
