"""Times gsplat on a scene: gsplat_render.py SCENE.ply WIDTH HEIGHT REPEATS.

Prints the milliseconds of a frame, the median over blocks of REPEATS frames. Without arguments it
only checks its imports. The camera is that of `zipsplat bench render`: at the origin, along z, with
a view as wide as it is distant.
"""

import statistics
import sys

try:
    import numpy  # noqa: F401
    import torch
    from gsplat import rasterization
except ImportError as error:
    sys.exit(f"{error.name} is not installed")
if not torch.cuda.is_available():
    sys.exit("PyTorch finds no CUDA GPU")
if len(sys.argv) == 1:
    sys.exit()

from scene import read_ply

BLOCKS = 5
path, width, height, repeats = sys.argv[1], *map(int, sys.argv[2:5])
means, scales, quats, opacities, sh, degree = read_ply(path, "cuda")
focal = float(max(width, height))
gaussians = {
    "means": means,
    "quats": quats,
    "scales": scales.exp(),
    "opacities": opacities[:, 0].sigmoid(),
    "colors": sh,
    "sh_degree": degree,
}
view = torch.eye(4, device="cuda")[None]
intrinsics = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], device="cuda")

# Consecutive frames, so that launching overlaps with the GPU's work.
times = []
with torch.no_grad():
    for _ in range(2 + BLOCKS):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        for _ in range(repeats):
            rasterization(**gaussians, viewmats=view, Ks=intrinsics, width=width, height=height)
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end) / repeats)
print(statistics.median(times[2:]))
