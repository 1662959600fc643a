"""gsplat's `rasterization` on any Vulkan device, with its arguments, shapes and results.

    from zipsplat.gsplat import rasterization        # for: from gsplat import rasterization

NumPy arrays return NumPy arrays. Torch tensors are differentiable in means, quats, scales,
opacities, colors, viewmats and backgrounds. The semantics are gsplat 1.5's.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Callable, Literal, Optional, Sequence

import numpy as np
import numpy.typing as npt

from ._projection import Meta
from ._rasterize import Settings, forward
from .device import DeviceLike, opened
from .errors import ArgumentError, UnsupportedError

Array = npt.NDArray[Any]

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# Harmonic of degree 0, and the offset of colors.
_SH_0, _OFFSET = 0.28209479177387814, 0.5
# Least shifted color, which keeps clamping at 0 away from values and gradients.
_LEAST = 1e-3
# Alpha below it counts as empty in expected depth.
_LEAST_ALPHA = 1e-10


def rasterization(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    viewmats: Any,
    Ks: Any,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: Optional[int] = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Any = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Any = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Any = None,
    tangential_coeffs: Any = None,
    thin_prism_coeffs: Any = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Any = None,
    *,
    device: DeviceLike = None,
) -> tuple[Any, Any, dict[str, Any]]:
    """Renders N Gaussians with C cameras, for any leading batch dimensions "...".

    Args:
        means: [..., N, 3] centers, world units.
        quats: [..., N, 4] rotations w, x, y, z, of any length but zero.
        scales: [..., N, 3] standard deviations, world units.
        opacities: [..., N] from 0 to 1.
        colors: [..., N, D] or [..., C, N, D] values; with `sh_degree` [..., N, K, 3] or
            [..., C, N, K, 3] coefficients.
        viewmats: [..., C, 4, 4] rigid world-to-camera matrices; gradients are along rigid motions.
        Ks: [..., C, 3, 3] intrinsics in pixels, without gradients, as in gsplat.
        width: Width in pixels.
        height: Height in pixels.
        near_plane, far_plane: Least and largest depth of a visible center.
        radius_clip: Gaussians of at most this radius in pixels are culled.
        sh_degree: Degree of spherical harmonics to use.
        packed: Whether the metadata has visible Gaussians only.
        backgrounds: [..., C, D] colors behind the scene.
        render_mode: "RGB", "D" accumulated depth, "ED" expected depth, "RGB+D" or "RGB+ED".
        rasterize_mode: "classic" or "antialiased".
        tile_size, channel_chunk, segmented: Ignored.
        device: The device, as for Device; None for that of CUDA tensors, else the best.

    Returns:
        Colors [..., C, height, width, X] with depth as the last channel; alphas
        [..., C, height, width, 1]; metadata with width, height, n_batches, n_cameras and, of
        projected Gaussians, means2d, radii, depths, conics, opacities and the ids of `packed`.
        means2d is a leaf tensor that receives gradients, for gsplat's strategies.

    Raises:
        UnsupportedError: an argument requests an unsupported feature.
        ArgumentError: a shape or value is invalid.

    Example:
        >>> colors, alphas, meta = rasterization(
        ...     means, quats, scales, opacities, colors, viewmats, Ks, 640, 480, sh_degree=3
        ... )
    """
    refused = {
        "eps2d": eps2d != 0.3,
        "sparse_grad": sparse_grad,
        "absgrad": absgrad,
        "distributed": distributed,
        "camera_model": camera_model != "pinhole",
        "covars": covars is not None,
        "with_ut": with_ut,
        "with_eval3d": with_eval3d,
        "radial_coeffs": radial_coeffs is not None,
        "tangential_coeffs": tangential_coeffs is not None,
        "thin_prism_coeffs": thin_prism_coeffs is not None,
        "ftheta_coeffs": ftheta_coeffs is not None,
        # gsplat's GLOBAL is no rolling shutter.
        "rolling_shutter": rolling_shutter is not None and getattr(rolling_shutter, "name", "") != "GLOBAL",
        "viewmats_rs": viewmats_rs is not None,
    }
    requested = [name for name, is_set in refused.items() if is_set]
    if requested:
        raise UnsupportedError(f"zipsplat's rasterization has only gsplat's default of {', '.join(requested)}")
    if render_mode not in _MODES or rasterize_mode not in ("classic", "antialiased"):
        raise ArgumentError(
            f"found render_mode {render_mode!r} and rasterize_mode {rasterize_mode!r}, expected one of {_MODES}, "
            "and 'classic' or 'antialiased'"
        )
    given = (means, quats, scales, opacities, colors, viewmats, Ks)
    xp = _library((*given, backgrounds))
    inputs = _Inputs(xp, given, backgrounds, sh_degree)
    settings = Settings(
        int(width),
        int(height),
        rasterize_mode == "antialiased",
        opened(xp.selector if device is None else device),
        (float(near_plane), float(far_plane)),
        float(radius_clip),
    )
    meta, visible = _metadata(xp, settings, inputs, packed)
    means2d = xp.means2d(meta, (inputs.batches, inputs.views, inputs.count, 2), inputs.differentiable)
    culls = far_plane < 1e10 or radius_clip > 0
    visibility = xp.array(visible()) if culls else None
    cameras = [slice(at, at + 1) for at in range(inputs.views)] if inputs.own or culls else [slice(None)]
    parts = []
    for b in range(inputs.batches):
        for span in cameras:
            geometry = [field[b] for field in inputs.geometry]
            if visibility is not None:
                geometry[3] = geometry[3] * visibility[b, span][0]
            values = inputs.colors[b, span][0] if inputs.own else inputs.colors[b]
            centers = None if means2d is None else means2d[b, span]
            lenses = (inputs.viewmats[b, span], inputs.Ks[b, span])
            parts.append(_draw(xp, settings, geometry, values, *lenses, sh_degree, render_mode, centers))
    rgb: Any
    alphas: Any
    depths: Any
    rgb, alphas, depths = (None if plane[0] is None else xp.concatenate(list(plane), 0) for plane in zip(*parts))
    if rgb is not None and inputs.backgrounds is not None:
        rgb = rgb + inputs.backgrounds * (1 - alphas)
    if render_mode.endswith("ED"):
        depths = depths / alphas.clip(_LEAST_ALPHA, None)
    planes = [plane for plane in (rgb, depths) if plane is not None]
    pixels = planes[0] if len(planes) == 1 else xp.concatenate(planes, -1)
    batch = (*inputs.batch, inputs.views)
    first, second = (xp.result(plane.reshape((*batch, *plane.shape[1:]))) for plane in (pixels, alphas))
    return first, second, meta


class _Inputs:
    """Checked arrays of a call, with the batch dimensions as one."""

    def __init__(self, xp: Any, fields: Sequence[Any], backgrounds: Any, sh_degree: Optional[int]) -> None:
        *geometry, colors, viewmats, Ks = (xp.array(field) for field in fields)
        self.batch = batch = tuple(geometry[0].shape[:-2])
        self.count, self.views = count, views = int(geometry[0].shape[-2]), int(viewmats.shape[-3])
        self.batches = math.prod(batch)
        _check("means", geometry[0], (*batch, count, 3))
        _check("quats", geometry[1], (*batch, count, 4))
        _check("scales", geometry[2], (*batch, count, 3))
        _check("opacities", geometry[3], (*batch, count))
        _check("viewmats", viewmats, (*batch, views, 4, 4))
        _check("Ks", Ks, (*batch, views, 3, 3))
        if not self.batches * views:
            raise ArgumentError(f"found {self.batches} batches and {views} cameras, expected at least one of each")
        # Whether cameras have colors of their own.
        self.own = colors.ndim == len(batch) + (3 if sh_degree is None else 4)
        tail = tuple(colors.shape[len(batch) + self.own + 1 :])
        right = len(tail) == 1 if sh_degree is None else tail[0] >= (sh_degree + 1) ** 2 and tail[1:] == (3,)
        if not right or tuple(colors.shape) != (*batch, *([views] if self.own else []), count, *tail):
            last = "D]" if sh_degree is None else "K, 3] with K at least (sh_degree + 1) ** 2"
            expected = f"[..., N, {last} or [..., C, N, {last}"
            raise ArgumentError(f"colors: found shape {list(colors.shape)}, expected {expected}")
        self.backgrounds = None
        if backgrounds is not None:
            backgrounds = xp.array(backgrounds)
            _check("backgrounds", backgrounds, (*batch, views, tail[-1]))
            self.backgrounds = backgrounds.reshape((self.batches * views, 1, 1, tail[-1]))
        *self.geometry, self.colors, self.viewmats, self.Ks = (
            field.reshape((self.batches, *field.shape[len(batch) :])) for field in (*geometry, colors, viewmats, Ks)
        )
        self.differentiable = (*geometry, colors, viewmats)


def _check(name: str, array: Any, shape: tuple[int, ...]) -> None:
    if tuple(array.shape) != shape:
        raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected {list(shape)}")


def _metadata(xp: Any, settings: Settings, inputs: _Inputs, packed: bool) -> tuple[dict[str, Any], Callable[[], Array]]:
    """Returns the metadata and a function that returns visibility [batches, C, N]."""

    @cache
    def projected() -> dict[str, Array]:
        arrays = zip(*inputs.geometry, inputs.viewmats, inputs.Ks)
        scenes = [settings.project(*(xp.host(array) for array in fields)) for fields in arrays]
        return {name: np.stack([scene[name] for scene in scenes]) for name in scenes[0]}

    def visible() -> Array:
        return np.asarray((projected()["radii"] > 0).all(-1))

    def described() -> dict[str, Any]:
        values: dict[str, Any] = {}
        ids = np.nonzero(visible()) if packed else (None, None, None)
        for name, value in projected().items():
            values[name] = value[ids] if packed else value.reshape((*inputs.batch, *value.shape[1:]))
        values.update(zip(("batch_ids", "camera_ids", "gaussian_ids"), ids))
        return {name: None if value is None else xp.described(value) for name, value in values.items()}

    size = {"width": settings.width, "height": settings.height}
    return Meta(described, **size, n_batches=inputs.batches, n_cameras=inputs.views), visible


def _draw(
    xp: Any,
    settings: Settings,
    geometry: Sequence[Any],
    colors: Any,
    viewmats: Any,
    Ks: Any,
    sh_degree: Optional[int],
    mode: str,
    means2d: Any,
) -> list[Any]:
    """Returns colors, alphas and accumulated depths of cameras with shared colors, or None.

    Gradients of projected centers go to `means2d`, if any.
    """
    depth = mode != "RGB"
    if not mode.startswith("RGB"):
        _, alphas, depths = xp.rasterize(settings, geometry, None, viewmats, Ks, True, means2d)
        return [None, alphas, depths]
    if sh_degree is not None:
        coeffs = colors[:, : (sh_degree + 1) ** 2]
        return list(xp.rasterize(settings, geometry, coeffs, viewmats, Ks, depth, means2d))
    # Batches of three channels, shifted above 0; the result is shifted back.
    channels = int(colors.shape[1])
    lowest = xp.lowest(colors)
    moved = lowest - 1 if lowest < _LEAST else 0.0
    rgb, alphas, depths = [], None, None
    for first in range(0, max(channels, 1), 3):
        values = colors[:, first : first + 3] - moved
        missing = 3 - int(values.shape[1])
        if missing:
            values = xp.concatenate([values, xp.ones_like(geometry[0][:, :missing])], 1)
        coeffs = ((values - _OFFSET) / _SH_0)[:, None, :]
        planes = xp.rasterize(settings, geometry, coeffs, viewmats, Ks, depth and first == 0, means2d)
        if first == 0:
            alphas, depths = planes[1:]
        rgb.append(planes[0][..., : 3 - missing] + moved * planes[1])
    return [xp.concatenate(rgb, -1), alphas, depths]


class _Numpy:
    """Array operations with NumPy."""

    selector = None

    @staticmethod
    def array(values: Any) -> Array:
        return np.asarray(values, np.float32)

    concatenate = staticmethod(np.concatenate)
    ones_like = staticmethod(np.ones_like)
    rasterize = staticmethod(forward)

    @staticmethod
    def lowest(values: Array) -> float:
        return float(values.min()) if values.size else 0.0

    @staticmethod
    def same(values: Any) -> Any:
        return values

    host = described = result = same

    @staticmethod
    def means2d(*_: object) -> None:
        """Returns no target of gradients."""


def _library(fields: Sequence[Any]) -> Any:
    """Returns the array backend: torch if any field is a tensor."""
    for field in fields:
        if type(field).__module__.split(".")[0] == "torch":
            from ._torch import Torch

            return Torch(field.device)
    return _Numpy
