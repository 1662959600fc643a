"""Blending against the golden pictures and gradients, and each implementation against the plain
one.

python tests/train/rasterize.py GOLDEN_FOLDER
"""

import os
import sys
from pathlib import Path

os.environ["TRITON_INTERPRET"] = "1"  # Triton's kernels on the CPU
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools" / "train"))

import torch
from safetensors.torch import load_file

import rasterize_numba
import rasterize_triton
from rasterize import blend_plain, rasterize

IMPLEMENTATIONS = {
    "plain": (blend_plain, torch.float64, 1e-6, 1e-5),
    "numba": (rasterize_numba.blend, torch.float32, 1e-5, 1e-4),
    "triton": (rasterize_triton.blend, torch.float32, 1e-5, 1e-4),
}


def packed(golden, dtype):
    parts = [golden[k] for k in ("means", "scales", "quats")] + [golden["opacities"][:, None], golden["sh"].flatten(1)]
    return torch.cat(parts, 1).to(dtype)[None]


def cameras(golden, dtype):
    k = golden["Ks"]
    intrinsics = torch.stack((k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]), -1)
    return golden["viewmats"].to(dtype)[None], intrinsics.to(dtype)[None], golden["size_wh"].flip(0).tolist()


def worst(found, truth, stable=None):
    error = (found.detach().double() - truth.double()).abs()
    return (error if stable is None else error[stable]).max().item()


def main(folder):
    failed = False

    def expect(what, error, limit):
        nonlocal failed
        good = error <= limit  # false for NaN
        failed |= not good
        print(f"{what}: {error:.1e} (limit {limit:.0e})" + ("" if good else "  FAILED"))

    for scene in ("rand50", "opaque_stack", "offcentre", "single"):
        golden = load_file(Path(folder) / f"raster.{scene}.safetensors")
        degree = int(golden["sh"].shape[1] ** 0.5) - 1
        stable = golden["v153/classic/unstable"] == 0
        for name, (blend, dtype, limit, _) in IMPLEMENTATIONS.items():
            view = rasterize(packed(golden, dtype), *cameras(golden, dtype), degree, blend)
            for plane in ("rgb", "alpha"):
                expect(
                    f"{scene} {name} {plane}",
                    worst(getattr(view, plane)[0], golden[f"v153/classic/{plane}"], stable),
                    limit,
                )
            depth = golden["v153/classic/D"]
            expect(f"{scene} {name} depth", worst(view.depth[0], depth, stable), limit * max(1, depth.max().item()))

    golden = load_file(Path(folder) / "raster.rand50.safetensors")
    grads = load_file(Path(folder) / "raster.rand50.grads.safetensors")
    truth = torch.cat([grads[f"classic/D/d_{k}"].flatten(1) for k in ("means", "scales", "quats")]
                      + [grads["classic/D/d_opacities"][:, None], grads["classic/D/d_sh"].flatten(1)], 1)  # fmt: skip
    for name, (blend, dtype, _, limit) in IMPLEMENTATIONS.items():
        gaussians = packed(golden, dtype).requires_grad_()
        view = rasterize(gaussians, *cameras(golden, dtype), 1, blend)
        loss = (grads["w_rgb"] * view.rgb).sum() + (grads["v_depth"] * view.depth).sum()
        (loss + (grads["u_alpha"] * view.alpha).sum()).backward()
        # Relative to each parameter's gradient.
        for kind, found, exact in zip("means scales quats opacities sh".split(), *(
            x.split((3, 3, 4, 1, 12), -1) for x in (gaussians.grad[0], truth))):  # fmt: skip
            expect(f"gradient {name} {kind}", worst(found, exact) / exact.square().mean().sqrt().item(), limit)

    sh2000 = load_file(Path(folder) / "raster.sh2000.safetensors")
    views = {name: rasterize(packed(sh2000, dtype), *cameras(sh2000, dtype), 1, blend)
             for name, (blend, dtype, *_) in IMPLEMENTATIONS.items() if name != "triton"}  # fmt: skip
    differ = (views["numba"].reached != views["plain"].reached).float().mean().item()
    expect("sh2000 numba reached", differ, 1e-3)
    raise SystemExit(failed)


if __name__ == "__main__":
    main(sys.argv[1])
