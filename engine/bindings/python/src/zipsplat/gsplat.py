"""gsplat's `rasterization` on any Vulkan device, with its arguments, shapes and results.

    from zipsplat.gsplat import rasterization        # for: from gsplat import rasterization

NumPy arrays return NumPy arrays. Torch tensors are differentiable in means, quats, scales,
opacities, colors, viewmats and backgrounds. The semantics are gsplat 1.5's.
"""

from __future__ import annotations

import math
import threading
from functools import cache
from typing import Any, Literal, Optional, Sequence

import numpy as np
import numpy.typing as npt

from ._native import call, ffi, lib, options, structure
from ._projection import Meta, project
from .cameras import Camera, Cameras, native
from .device import Device, DeviceLike, opened
from .errors import ArgumentError, UnsupportedError
from .renderer import Renderer, render_buffers
from .scene import Scene

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
    given = [name for name, found in refused.items() if found]
    if given:
        raise UnsupportedError(f"zipsplat's rasterization has only gsplat's default of {', '.join(given)}")
    if render_mode not in _MODES or rasterize_mode not in ("classic", "antialiased"):
        raise ArgumentError(
            f"found render_mode {render_mode!r} and rasterize_mode {rasterize_mode!r}, expected one of {_MODES}, "
            "and 'classic' or 'antialiased'"
        )
    fields = (means, quats, scales, opacities, colors, viewmats, Ks)
    xp = _library((*fields, backgrounds))
    *geometry, colors, viewmats, Ks = (xp.array(field) for field in fields)
    batch, count, views = tuple(geometry[0].shape[:-2]), int(geometry[0].shape[-2]), int(viewmats.shape[-3])
    for name, array, shape in zip(
        ("means", "quats", "scales", "opacities", "viewmats", "Ks"),
        (*geometry, viewmats, Ks),
        ((count, 3), (count, 4), (count, 3), (count,), (views, 4, 4), (views, 3, 3)),
    ):
        if tuple(array.shape) != (*batch, *shape):
            raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected {[*batch, *shape]}")
    own = colors.ndim == len(batch) + (3 if sh_degree is None else 4)
    shape = tuple(colors.shape[len(batch) + own :])
    right = len(shape) == 2 if sh_degree is None else len(shape) == 3 and shape[1] >= (sh_degree + 1) ** 2
    right = right and (sh_degree is None or shape[2] == 3)
    if not right or tuple(colors.shape) != (*batch, *([views] if own else []), count, *shape[1:]):
        tail = "D]" if sh_degree is None else "K, 3] with K at least (sh_degree + 1) ** 2"
        raise ArgumentError(f"colors: found shape {list(colors.shape)}, expected [..., N, {tail} or [..., C, N, {tail}")
    if backgrounds is not None:
        backgrounds = xp.array(backgrounds)
        channels = 3 if sh_degree is not None else shape[1]
        if tuple(backgrounds.shape) != (*batch, views, channels):
            raise ArgumentError(
                f"backgrounds: found shape {list(backgrounds.shape)}, expected {[*batch, views, channels]}"
            )
    batches = math.prod(batch)
    geometry = [field.reshape((batches, *field.shape[len(batch) :])) for field in geometry]
    colors = colors.reshape((batches, *colors.shape[len(batch) :]))
    viewmats, Ks = viewmats.reshape((batches, views, 4, 4)), Ks.reshape((batches, views, 3, 3))
    how = _How(
        int(width),
        int(height),
        rasterize_mode == "antialiased",
        opened(xp.selector if device is None else device),
        float(near_plane),
    )

    @cache
    def projected() -> dict[str, Array]:
        def of(*fields: Any) -> dict[str, Array]:
            planes, clip = (float(near_plane), float(far_plane)), float(radius_clip)
            size, antialiased = (how.width, how.height), how.antialiased
            *gaussians, views, lenses = (xp.host(field) for field in fields)
            return project(gaussians, views, lenses, size, antialiased=antialiased, planes=planes, radius_clip=clip)

        found = [of(*fields) for fields in zip(*geometry, viewmats, Ks)]
        return {name: np.stack([one[name] for one in found]) for name in found[0]}

    def described() -> dict[str, Any]:
        values: dict[str, Any] = projected()
        ids: Sequence[Any] = (None, None, None)
        if packed:
            ids = np.nonzero((values["radii"] > 0).all(-1))
            values = {name: value[ids] for name, value in values.items()}
        else:
            values = {name: value.reshape((*batch, *value.shape[1:])) for name, value in values.items()}
        values.update(zip(("batch_ids", "camera_ids", "gaussian_ids"), ids))
        return {name: None if value is None else xp.described(value) for name, value in values.items()}

    meta = Meta(described, width=how.width, height=how.height, n_batches=batches, n_cameras=views)
    means2d = xp.means2d(meta, (batches, views, count, 2), (*geometry, colors, viewmats))
    culls = far_plane < 1e10 or radius_clip > 0
    kept = xp.array((projected()["radii"] > 0).all(-1)) if culls else None

    def draw(b: int, first: int, last: int) -> list[Any]:
        fields = [field[b] for field in geometry]
        if kept is not None:
            fields[3] = fields[3] * kept[b, first]
        places = (viewmats[b, first:last], Ks[b, first:last])
        centers = None if means2d is None else means2d[b, first:last]
        return _draw(xp, how, fields, colors[b, first] if own else colors[b], *places, sh_degree, render_mode, centers)

    spans = [(at, at + 1) for at in range(views)] if own or culls else [(0, views)]
    parts = [draw(b, *span) for b in range(batches) for span in spans]
    rgb: Any
    alphas: Any
    depths: Any
    rgb, alphas, depths = (None if plane[0] is None else xp.concatenate(list(plane), 0) for plane in zip(*parts))
    if rgb is not None and backgrounds is not None:
        rgb = rgb + backgrounds.reshape((batches * views, 1, 1, -1)) * (1 - alphas)
    if render_mode.endswith("ED"):
        depths = depths / alphas.clip(_LEAST_ALPHA, None)
    planes = [plane for plane in (rgb, depths) if plane is not None]
    found = planes[0] if len(planes) == 1 else xp.concatenate(planes, -1)
    first, second = (xp.result(plane.reshape((*batch, views, *plane.shape[1:]))) for plane in (found, alphas))
    return first, second, meta


class _How:
    """Drawing settings shared by all pictures of a call."""

    def __init__(self, width: int, height: int, antialiased: bool, device: Device, near: float = 0.01) -> None:
        self.width, self.height, self.antialiased, self.near, self.device = width, height, antialiased, near, device

    def cameras(self, viewmats: Array, Ks: Array) -> Cameras:
        if (viewmats[:, 3] != [0, 0, 0, 1]).any():
            raise ArgumentError("viewmats: expected a last row of 0, 0, 0, 1")
        return Camera.from_matrices(Ks, self.width, self.height, world_to_camera=viewmats)

    def options(self) -> Any:
        kind, depth = lib.ZS_PIXEL_RGB_F32, lib.ZS_DEPTH_MODE_ACCUMULATED
        return options("render", format=kind, depth=depth, antialiased=int(self.antialiased), near_plane=self.near)


def _draw(
    xp: Any,
    how: _How,
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
        _, alphas, depths = xp.rasterize(how, geometry, None, viewmats, Ks, True, means2d)
        return [None, alphas, depths]
    if sh_degree is not None:
        coeffs = colors[:, : (sh_degree + 1) ** 2]
        return list(xp.rasterize(how, geometry, coeffs, viewmats, Ks, depth, means2d))
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
        drawn = xp.rasterize(how, geometry, coeffs, viewmats, Ks, depth and first == 0, means2d)
        if first == 0:
            alphas, depths = drawn[1:]
        rgb.append(drawn[0][..., : 3 - missing] + moved * drawn[1])
    return [xp.concatenate(rgb, -1), alphas, depths]


class _Renderers(threading.local):
    """A renderer per thread, for the most recent device."""

    def __init__(self) -> None:
        self.renderer: Optional[Renderer] = None

    def of(self, scene: Scene, device: Device) -> Renderer:
        if self.renderer is None or self.renderer.device is not device:
            self.renderer = Renderer(scene, device)
        else:
            self.renderer.set_scene(scene)
        return self.renderer


_renderers = _Renderers()


def _scene(geometry: Sequence[Array], coeffs: Optional[Array]) -> Scene:
    means, quats, scales, opacities = geometry
    return Scene.from_arrays(
        means, scales, quats, opacities, np.zeros((len(means), 1, 3)) if coeffs is None else coeffs
    )


def _forward(
    how: _How,
    geometry: Sequence[Array],
    coeffs: Optional[Array],
    viewmats: Array,
    Ks: Array,
    depth: bool,
    _means2d: None = None,
) -> tuple[Optional[Array], Array, Optional[Array]]:
    """Returns colors [C, height, width, 3], alphas and depths [C, height, width, 1]."""
    views, shape = how.cameras(viewmats, Ks), (len(viewmats), how.height, how.width)
    rgb = None if coeffs is None else np.empty((*shape, 3), np.float32)
    alphas, depths = np.empty((*shape, 1), np.float32), np.empty((*shape, 1), np.float32) if depth else None
    scene = _scene(geometry, coeffs)
    renderer = _renderers.of(scene, how.device)
    call("zs_render", renderer._handle, native(views), render_buffers(rgb, alphas, depths), len(views), how.options())
    return rgb, alphas, depths


def _backward(
    how: _How,
    geometry: Sequence[Array],
    coeffs: Optional[Array],
    viewmats: Array,
    Ks: Array,
    weights: Sequence[Optional[Array]],
    of_cameras: bool,
    of_means2d: bool = False,
) -> tuple[dict[str, Array], Optional[Array]]:
    """Returns gradients of the scene's arrays and, on request, of means2d and of viewmats."""
    scene, views = _scene(geometry, coeffs), how.cameras(viewmats, Ks)
    found = {
        name: np.zeros(getattr(scene, name).shape, np.float32)
        for name in ("means", "scales", "quats", "opacities", "sh_coeffs")
    }
    if of_means2d:
        found["means2d"] = np.zeros((len(views), len(geometry[0]), 2), np.float32)
    moved = np.zeros((len(views), 10), np.float32)
    to = structure("gradients", **{name: ffi.cast("float *", array.ctypes.data) for name, array in found.items()})
    if of_cameras:
        to.cameras = ffi.cast("float *", moved.ctypes.data)
    kept = [None if plane is None else np.ascontiguousarray(plane, np.float32) for plane in weights]
    if all(plane is None for plane in kept):
        return found, np.zeros_like(viewmats) if of_cameras else None
    renderer = _renderers.of(scene, how.device)
    arguments = (native(views), render_buffers(kept[0], kept[1], kept[2]), len(views), how.options(), to)
    call("zs_render_backward", renderer._handle, scene._handle, *arguments)
    return found, _by_viewmats(viewmats, moved) if of_cameras else None


def _by_viewmats(viewmats: Array, moved: Array) -> Array:
    """Converts a gradient of (w, v), with camera-to-world R exp(w^), t + R v, to world-to-camera.

    Returns the smallest gradient that agrees on rigid motions. A viewmat [A | b] moves as
    exp(-w^) [A | b] - [0 | v], so w = -(sum of a x d over its columns) and v = -d of b.
    """
    out = np.zeros(viewmats.shape, np.float32)
    for to, matrix, (w, v) in zip(out, viewmats, ((row[:3], row[3:6]) for row in moved.astype(np.float64))):
        turn = w - np.cross(matrix[:3, 3], v)
        to[:3, 3] = -v
        # Summed over three orthonormal axes, a x (w x a) is 2 w.
        to[:3, :3] = np.stack([-0.5 * np.cross(turn, matrix[:3, axis]) for axis in range(3)], axis=1)
    return out


class _Numpy:
    """Array operations with NumPy."""

    selector = None

    @staticmethod
    def array(values: Any) -> Array:
        return np.asarray(values, np.float32)

    concatenate = staticmethod(np.concatenate)
    ones_like = staticmethod(np.ones_like)
    rasterize = staticmethod(_forward)

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
