"""Rendering and gradients of arrays by the library."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, Optional, Sequence

import numpy as np
import numpy.typing as npt

from ._native import call, ffi, lib, structure, structures
from ._projection import project
from .cameras import Camera, Cameras, native
from .device import Device
from .errors import ArgumentError
from .renderer import Renderer
from .scene import FIELDS

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Settings:
    """Settings shared by all images of a call."""

    width: int
    height: int
    antialiased: bool
    device: Device
    planes: tuple[float, float] = (0.01, 1e10)
    radius_clip: float = 0.0

    def project(self, *fields: Array) -> dict[str, Array]:
        *gaussians, viewmats, Ks = fields
        size = (self.width, self.height)
        return project(gaussians, viewmats, Ks, size, self.antialiased, self.planes, self.radius_clip)

    def cameras(self, viewmats: Array, Ks: Array) -> Cameras:
        if (viewmats[:, 3] != [0, 0, 0, 1]).any():
            raise ArgumentError("viewmats: expected a last row of 0, 0, 0, 1")
        return Camera.from_matrices(Ks, self.width, self.height, world_to_camera=viewmats)

    def options(self) -> Any:
        kind, depth = lib.ZS_PIXEL_RGB_F32, lib.ZS_DEPTH_MODE_ACCUMULATED
        mode = lib.ZS_ANTIALIASING_ON if self.antialiased else lib.ZS_ANTIALIASING_OFF
        return structure("render_options", format=kind, depth=depth, antialiasing=mode, near_plane=self.planes[0])


class _Renderers(threading.local):
    """A renderer per thread, for the most recent device."""

    def __init__(self) -> None:
        self.renderer: Optional[Renderer] = None

    def of(self, arrays: Sequence[Array], device: Device) -> Renderer:
        if self.renderer is None or self.renderer.device is not device:
            self.renderer = Renderer(device=device)
        self.renderer.update_gaussians(*arrays)
        return self.renderer


_renderers = _Renderers()


def _arrays(geometry: Sequence[Array], coeffs: Optional[Array]) -> tuple[Array, ...]:
    """Returns arrays in the order of FIELDS."""
    means, quats, scales, opacities = geometry
    return means, scales, quats, opacities, np.zeros((len(means), 1, 3), np.float32) if coeffs is None else coeffs


def forward(
    settings: Settings,
    geometry: Sequence[Array],
    coeffs: Optional[Array],
    viewmats: Array,
    Ks: Array,
    depth: bool,
    _means2d: None = None,
) -> tuple[Optional[Array], Array, Optional[Array]]:
    """Returns colors [C, height, width, 3], alphas and depths [C, height, width, 1]."""
    views, shape = settings.cameras(viewmats, Ks), (len(viewmats), settings.height, settings.width)
    rgb = None if coeffs is None else np.empty((*shape, 3), np.float32)
    alphas, depths = np.empty((*shape, 1), np.float32), np.empty((*shape, 1), np.float32) if depth else None
    renderer = _renderers.of(_arrays(geometry, coeffs), settings.device)
    call(
        "zs_render",
        renderer._handle,
        native(views),
        structures("render_buffers", pixels=rgb, alpha=alphas, depth=depths),
        len(views),
        settings.options(),
    )
    return rgb, alphas, depths


def backward(
    settings: Settings,
    geometry: Sequence[Array],
    coeffs: Optional[Array],
    viewmats: Array,
    Ks: Array,
    weights: Sequence[Optional[Array]],
    of_cameras: bool,
    of_means2d: bool = False,
) -> tuple[dict[str, Array], Optional[Array]]:
    """Returns gradients of the scene's arrays and, on request, of means2d and of viewmats."""
    views = settings.cameras(viewmats, Ks)
    arrays = _arrays(geometry, coeffs)
    found = {name: np.zeros(array.shape, np.float32) for name, array in zip(FIELDS, arrays)}
    if of_means2d:
        found["means2d"] = np.zeros((len(views), len(geometry[0]), 2), np.float32)
    moved = np.zeros((len(views), 10), np.float32)
    to = structure("gradients", **{name: ffi.cast("float *", array.ctypes.data) for name, array in found.items()})
    if of_cameras:
        to.cameras = ffi.cast("float *", moved.ctypes.data)
    grad_outputs = [None if plane is None else np.require(plane, np.float32, ["C", "A"]) for plane in weights]
    if all(plane is None for plane in grad_outputs):
        return found, np.zeros_like(viewmats) if of_cameras else None
    renderer = _renderers.of(arrays, settings.device)
    arguments = (
        native(views),
        structures("grad_outputs", color=grad_outputs[0], alpha=grad_outputs[1], depth=grad_outputs[2]),
        len(views),
        settings.options(),
        to,
    )
    call("zs_render_backward", renderer._handle, ffi.NULL, *arguments)
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
