"""Times gsplat on a scene: gsplat_render.py SCENE.ply WIDTH HEIGHT REPEATS. Prints the milliseconds of a frame, the
median of blocks of REPEATS frames.
Without arguments it only says whether it could.

The camera is that of `zipsplat bench render`: at the world's origin, looking along z, as wide as what it sees is far.
"""

import statistics
import sys

import numpy as np

try:
    import torch
    from gsplat import rasterization
except ImportError as error:
    sys.exit(f"{error.name} is not installed")
if not torch.cuda.is_available():
    sys.exit("PyTorch finds no CUDA GPU")
if len(sys.argv) == 1:
    sys.exit()

BLOCKS = 5
path, width, height, repeats = sys.argv[1], *map(int, sys.argv[2:5])
with open(path, "rb") as file:
    names = []
    while (line := file.readline().decode().split()) != ["end_header"]:
        if line[0] == "property":
            names.append(line[2])
    table = np.fromfile(file, dtype="<f4").reshape(-1, len(names))
column = {name: torch.from_numpy(table[:, i].copy()).cuda() for i, name in enumerate(names)}


def stack(prefix, count):
    return torch.stack([column[f"{prefix}{i}"] for i in range(count)], -1)


rest = sum(name.startswith("f_rest_") for name in names) // 3
sh = stack("f_dc_", 3)[:, None]
if rest:
    sh = torch.cat([sh, stack("f_rest_", 3 * rest).view(-1, 3, rest).transpose(1, 2)], 1)
focal = float(max(width, height))
gaussians = {
    "means": torch.stack([column[axis] for axis in "xyz"], -1),
    "quats": stack("rot_", 4),
    "scales": stack("scale_", 3).exp(),
    "opacities": column["opacity"].sigmoid(),
    "colors": sh.contiguous(),
    "sh_degree": round((rest + 1) ** 0.5) - 1,
}
view = torch.eye(4, device="cuda")[None]
intrinsics = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], device="cuda")

# Frames in a row, so that the GPU works on one while Python launches the next: alone, a small one would be all launching.
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
