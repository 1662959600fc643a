"""gsplat's `rasterization` on any Vulkan device, with its arguments, shapes and results.

    from zipsplat.gsplat import rasterization        # for: from gsplat import rasterization

NumPy arrays return NumPy arrays. Torch tensors are differentiable in means, quats, scales,
opacities, colors, viewmats and backgrounds. The semantics are gsplat 1.5's.
"""

from __future__ import annotations

import threading
from typing import Any, Optional, Sequence

import numpy as np
import numpy.typing as npt

from ._native import call, ffi, lib, options, structure
from .cameras import Camera, Cameras, native
from .device import Device, DeviceLike, opened
from .errors import ArgumentError, UnsupportedError
from .renderer import Renderer, render_buffers
from .scene import Scene

Array = npt.NDArray[Any]

_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# Harmonic of degree 0, and the offset of colors.
_SH_0, _OFFSET = 0.28209479177387814, 0.5
# Least shifted color, which keeps clamping at 0 away from values and gradients.
_LEAST = 1e-3
# Alpha below it counts as empty in expected depth.
_LEAST_ALPHA = 1e-10


class _Meta(dict[str, Any]):
    """Metadata of a picture, without gsplat's intermediate results."""

    def __missing__(self, key: str) -> Any:
        raise KeyError(
            f"{key}: zipsplat's rasterization keeps nothing between projection and blending, only {', '.join(self)}"
        )


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
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
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
    """Draws N Gaussians with C cameras.

    Args:
        means: [N, 3] centers, world units.
        quats: [N, 4] rotations w, x, y, z, of any length but zero.
        scales: [N, 3] standard deviations, world units.
        opacities: [N] from 0 to 1.
        colors: [N, D] or [C, N, D] values; with `sh_degree` [N, K, 3] or [C, N, K, 3] coefficients.
        viewmats: [C, 4, 4] rigid world-to-camera matrices; gradients are along rigid motions.
        Ks: [C, 3, 3] intrinsics in pixels, without gradients, as in gsplat.
        width: Width in pixels.
        height: Height in pixels.
        sh_degree: Degree of spherical harmonics to use.
        backgrounds: [C, D] colors behind the scene.
        render_mode: "RGB", "D" accumulated depth, "ED" expected depth, "RGB+D" or "RGB+ED".
        rasterize_mode: "classic" or "antialiased".
        packed, tile_size, channel_chunk, segmented: Ignored.
        device: The device, as for Device; None for the best.

    Returns:
        Colors [C, height, width, X] with depth as the last channel; alphas [C, height, width, 1];
        metadata with width, height and n_cameras.

    Raises:
        UnsupportedError: an argument requests an unsupported feature.
        ArgumentError: a shape or value is invalid.
    """
    refused = {
        "far_plane": far_plane != 1e10,
        "radius_clip": radius_clip != 0.0,
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
    means, quats, scales, opacities, colors, viewmats, Ks = (xp.array(field) for field in fields)
    count, views = len(means), len(viewmats)
    shapes = {
        "means": (means, (count, 3)),
        "quats": (quats, (count, 4)),
        "scales": (scales, (count, 3)),
        "opacities": (opacities, (count,)),
        "viewmats": (viewmats, (views, 4, 4)),
        "Ks": (Ks, (views, 3, 3)),
    }
    for name, (array, shape) in shapes.items():
        if tuple(array.shape) != shape:
            raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected {list(shape)}")
    own = colors.ndim == (3 if sh_degree is None else 4)
    shape = tuple(colors.shape[1:] if own else colors.shape)
    right = (
        len(shape) == 2 if sh_degree is None else len(shape) == 3 and shape[2] == 3 and shape[1] >= (sh_degree + 1) ** 2
    )
    if not right or shape[0] != count or own and len(colors) != views:
        expected = (
            "[N, D] or [C, N, D]"
            if sh_degree is None
            else "[N, K, 3] or [C, N, K, 3] with K at least (sh_degree + 1) ** 2"
        )
        raise ArgumentError(f"colors: found shape {list(colors.shape)}, expected {expected}")
    how = _How(int(width), int(height), rasterize_mode == "antialiased", opened(device), float(near_plane))
    if backgrounds is not None:
        backgrounds = xp.array(backgrounds)

    def draw(colors: Any, first: int, last: int) -> list[Any]:
        return _draw(
            xp,
            how,
            (means, quats, scales, opacities),
            colors,
            viewmats[first:last],
            Ks[first:last],
            sh_degree,
            render_mode,
        )

    parts = [draw(colors[i], i, i + 1) for i in range(views)] if own else [draw(colors, 0, views)]
    rgb: Any
    alphas: Any
    depths: Any
    rgb, alphas, depths = (None if plane[0] is None else xp.concatenate(list(plane), 0) for plane in zip(*parts))
    if rgb is not None and backgrounds is not None:
        if tuple(backgrounds.shape) != (views, rgb.shape[-1]):
            raise ArgumentError(
                f"backgrounds: found shape {list(backgrounds.shape)}, expected {[views, rgb.shape[-1]]}"
            )
        rgb = rgb + backgrounds[:, None, None, :] * (1 - alphas)
    if render_mode.endswith("ED"):
        depths = depths / alphas.clip(_LEAST_ALPHA, None)
    planes = [plane for plane in (rgb, depths) if plane is not None]
    meta = _Meta(width=how.width, height=how.height, n_cameras=views)
    return xp.result(planes[0] if len(planes) == 1 else xp.concatenate(planes, -1)), xp.result(alphas), meta


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
) -> list[Any]:
    """Returns colors, alphas and accumulated depths of cameras with shared colors, or None."""
    depth = mode != "RGB"
    if not mode.startswith("RGB"):
        _, alphas, depths = xp.rasterize(how, geometry, None, viewmats, Ks, True)
        return [None, alphas, depths]
    if sh_degree is not None:
        coeffs = colors[:, : (sh_degree + 1) ** 2]
        return list(xp.rasterize(how, geometry, coeffs, viewmats, Ks, depth))
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
        drawn = xp.rasterize(how, geometry, coeffs, viewmats, Ks, depth and first == 0)
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
    how: _How, geometry: Sequence[Array], coeffs: Optional[Array], viewmats: Array, Ks: Array, depth: bool
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
) -> tuple[dict[str, Array], Optional[Array]]:
    """Returns gradients of means, scales, quats, opacities, sh_coeffs and, on request, viewmats."""
    scene, views = _scene(geometry, coeffs), how.cameras(viewmats, Ks)
    found = {
        name: np.zeros(getattr(scene, name).shape, np.float32)
        for name in ("means", "scales", "quats", "opacities", "sh_coeffs")
    }
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
    def result(values: Any) -> Any:
        return values


def _library(fields: Sequence[Any]) -> Any:
    """Returns the array backend: torch if any field is a tensor."""
    for field in fields:
        if type(field).__module__.split(".")[0] == "torch":
            from ._torch import Torch

            return Torch(field.device)
    return _Numpy
