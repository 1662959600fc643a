"""Reads PLY scenes for benchmarks."""

import numpy as np
import torch


def read_ply(path, device):
    """Reads raw Gaussians and their SH degree.

    means [N, 3], scales [N, 3] (logarithms), quats [N, 4] wxyz, opacities [N, 1] (logits),
    sh [N, K, 3].
    """
    with open(path, "rb") as file:
        names = []
        while (line := file.readline().decode().split()) != ["end_header"]:
            if line[0] == "property":
                names.append(line[2])
        table = np.fromfile(file, dtype="<f4").reshape(-1, len(names))
    column = {name: torch.from_numpy(table[:, i].copy()).to(device) for i, name in enumerate(names)}

    def stack(prefix, count):
        return torch.stack([column[f"{prefix}{i}"] for i in range(count)], -1)

    means = torch.stack([column[axis] for axis in "xyz"], -1)
    rest = sum(name.startswith("f_rest_") for name in names) // 3
    sh = stack("f_dc_", 3)[:, None]
    if rest:
        sh = torch.cat([sh, stack("f_rest_", 3 * rest).view(-1, 3, rest).transpose(1, 2)], 1)
    degree = round((rest + 1) ** 0.5) - 1
    return means, stack("scale_", 3), stack("rot_", 4), column["opacity"][:, None], sh.contiguous(), degree
