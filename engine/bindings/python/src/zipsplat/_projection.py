"""Projected Gaussians as in gsplat: the metadata of a rasterization."""

from __future__ import annotations

from typing import Any, Callable, Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

# The kernels' constants, which are gsplat's: see kernels/shared/splat.glsl.
_ALPHA_MIN, _BLUR, _MARGIN, _EXTENT_MAX = 1 / 255, 0.3, 0.15, 3.33

NAMES = ("means2d", "radii", "depths", "conics", "opacities", "batch_ids", "camera_ids", "gaussian_ids")


class Meta(dict[str, Any]):
    """Metadata of a rasterization. Projected Gaussians are computed on first access."""

    def __init__(self, project: Callable[[], dict[str, Any]], **values: Any) -> None:
        super().__init__(**values)
        self._project = project

    def __missing__(self, key: str) -> Any:
        if key not in NAMES:
            raise KeyError(f"{key}: found none in the metadata, expected one of {', '.join([*self, *NAMES])}")
        self.update(self._project())
        return self[key]


def project(
    gaussians: Sequence[Array],
    viewmats: Array,
    Ks: Array,
    size: tuple[int, int],
    *,
    antialiased: bool,
    planes: tuple[float, float],
    radius_clip: float,
) -> dict[str, Array]:
    """Projects Gaussians to cameras as `rasterization`, whose arguments it has.

    Args:
        gaussians: means, quats, scales, opacities.
        size: Width and height in pixels.
        planes: Near and far plane.

    Returns:
        means2d [C, N, 2] in pixels, radii [C, N, 2] int32 in pixels, 0 if culled, depths [C, N],
        conics [C, N, 3] as upper triangles, opacities [C, N].
    """
    means, quats, scales, opacities = gaussians
    axes = _rotations(quats) * scales[:, None, :]
    found: list[list[Array]] = []
    with np.errstate(all="ignore"):
        for view, K in zip(viewmats, Ks):
            focal, center = K[(0, 1), (0, 1)], K[:2, 2]
            points = means @ view[:3, :3].T + view[:3, 3]
            depths = points[:, 2]
            slopes = points[:, :2] / depths[:, None]
            means2d = focal * slopes + center
            # The Jacobian's slopes are clamped beyond the image.
            margin = _MARGIN * np.array(size) / focal
            held = slopes.clip(-center / focal - margin, (size - center) / focal + margin)
            rows = view[:3, :3] @ axes
            u, v = ((focal / depths[:, None]).T[..., None]) * (rows[:, :2] - held[..., None] * rows[:, 2:]).swapaxes(
                0, 1
            )
            xx, xy, yy = ((a * b).sum(-1) for a, b in ((u, u), (u, v), (v, v)))
            sharp = np.square(np.cross(u, v)).sum(-1)
            det = sharp + _BLUR * (xx + yy) + _BLUR**2
            seen = opacities * np.sqrt(sharp / det) if antialiased else opacities
            extent = np.sqrt(2 * np.log(seen / _ALPHA_MIN)).clip(None, _EXTENT_MAX)
            radii = np.ceil(extent[:, None] * np.sqrt(np.stack([xx, yy], -1) + _BLUR))
            kept = (depths >= planes[0]) & (depths <= planes[1]) & (radii > radius_clip).any(-1)
            kept &= ((means2d + radii > 0) & (means2d - radii < size)).all(-1)
            conics = np.stack([yy + _BLUR, -xy, xx + _BLUR], -1) / det[:, None]
            found.append([means2d, np.where(kept[:, None], radii, 0).astype(np.int32), depths, conics, seen])
    stacked = [np.stack(values).astype(values[0].dtype) for values in zip(*found)]
    return dict(zip(NAMES, stacked))


def _rotations(quats: Array) -> Array:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=-1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
