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
    means, quats, scales, opacities = (field.T for field in gaussians)
    sides = np.array(size, np.float32)[:, None]
    axes = (_rotations(quats) * scales).reshape(3, -1)
    found: list[list[Array]] = []
    with np.errstate(all="ignore"):
        # Rows are components, columns Gaussians.
        for view, K in zip(viewmats, Ks):
            focal, center = K[(0, 1), (0, 1)][:, None], K[:2, 2:]
            points = view[:3, :3] @ means + view[:3, 3:]
            depths = points[2]
            slopes = points[:2] / depths
            means2d = focal * slopes + center
            # The Jacobian's slopes are clamped beyond the image.
            margin = np.float32(_MARGIN) * sides / focal
            held = slopes.clip(-center / focal - margin, (sides - center) / focal + margin)
            rows = (view[:3, :3] @ axes).reshape(3, 3, -1)
            u, v = (focal / depths)[:, None] * (rows[:2] - held[:, None] * rows[2])
            xx, xy, yy = ((a * b).sum(0) for a, b in ((u, u), (u, v), (v, v)))
            sharp = np.square(np.cross(u, v, axis=0)).sum(0)
            det = sharp + _BLUR * (xx + yy) + _BLUR**2
            compensated = opacities * np.sqrt(sharp / det) if antialiased else opacities
            extent = np.sqrt(2 * np.log(compensated / np.float32(_ALPHA_MIN))).clip(None, _EXTENT_MAX)
            radii = np.ceil(extent * np.sqrt(np.stack([xx, yy]) + _BLUR))
            visible = (depths >= planes[0]) & (depths <= planes[1]) & (radii > radius_clip).any(0)
            visible &= ((means2d + radii > 0) & (means2d - radii < sides)).all(0)
            conics = np.stack([yy + _BLUR, -xy, xx + _BLUR], -1) / det[:, None]
            found.append([means2d.T, np.where(visible, radii, 0).T.astype(np.int32), depths, conics, compensated])
    return dict(zip(NAMES, (np.stack(values) for values in zip(*found))))


def _rotations(quats: Array) -> Array:
    """Returns [3, 3, N] rotations of [4, N] quaternions."""
    w, x, y, z = quats / np.linalg.norm(quats, axis=0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
