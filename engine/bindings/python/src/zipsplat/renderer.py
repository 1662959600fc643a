"""Renderers: images of scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Iterable, Literal, Optional, Sequence, Union

import numpy as np
import numpy.typing as npt

from ._native import Handle, Owner, call, ffi, lib, structure, structures
from .cameras import Camera, native
from .device import DeviceLike, opened
from .errors import ArgumentError, ArgumentTypeError
from .scene import ANTIALIASING, Scene, native_gaussians

DepthMode = Literal["expected", "accumulated"]
_DEPTHS = {"expected": lib.ZS_DEPTH_MODE_EXPECTED, "accumulated": lib.ZS_DEPTH_MODE_ACCUMULATED}


@dataclass(frozen=True)
class RenderOutput:
    """Pictures of one camera or, with a leading axis C, of several.

    Attributes:
        rgb: [C, height, width, 3] over the background: uint8, clamped and truncated, or float32.
        alpha: [C, height, width] float32 from 0 to 1, if requested.
        depth: [C, height, width] float32 along the camera's z axis in world units, if requested.
        normals: [C, height, width, 3] float32 unit vectors in the world, toward the camera, 0 where
            empty, if requested.
    """

    rgb: npt.NDArray[Any]
    alpha: Optional[npt.NDArray[np.float32]] = None
    depth: Optional[npt.NDArray[np.float32]] = None
    normals: Optional[npt.NDArray[np.float32]] = None


class Renderer(Owner):
    """A scene on a device, ready to render. Repeated image sizes and kinds are fast.

    Concurrent calls wait for each other.

    Args:
        scene: Scene to upload; None sets none yet.
        device: The device, as for Device; None for the scene's own or the best.

    Example:
        >>> with Renderer(scene) as renderer:
        ...     output = renderer.render(capture.cameras[:8])  # output.rgb [8, height, width, 3]
    """

    def __init__(self, scene: Optional[Scene] = None, device: DeviceLike = None) -> None:
        self.device = opened(device if scene is None or device is not None else scene._device)
        given = ffi.NULL if scene is None else scene._scene
        super().__init__(Handle("renderer", "zs_renderer_create", self.device._handle, given))

    def set_scene(self, scene: Scene) -> None:
        """Replaces the scene. Cheap for an equal number of Gaussians and degree."""
        call("zs_renderer_set_scene", self._handle, scene._scene)

    def update_gaussians(
        self,
        means: npt.ArrayLike,
        scales: npt.ArrayLike,
        quats: npt.ArrayLike,
        opacities: npt.ArrayLike,
        sh_coeffs: npt.ArrayLike,
        *,
        antialiased: bool = False,
    ) -> None:
        """Replaces the scene by copies of arrays, as Scene.from_arrays, for an optimizer.

        In place for an equal number of Gaussians and degree.
        """
        gaussians, _arrays = native_gaussians(means, scales, quats, opacities, sh_coeffs, antialiased=antialiased)
        call("zs_renderer_update_gaussians", self._handle, gaussians)

    def render(
        self,
        cameras: Union[Camera, Sequence[Camera]],
        *,
        alpha: bool = False,
        depth: Optional[DepthMode] = None,
        normals: bool = False,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        antialiased: Optional[bool] = None,
        dtype: npt.DTypeLike = np.uint8,
    ) -> RenderOutput:
        """Renders the scene.

        Args:
            cameras: A camera, or several of one size, in the scene's world.
            alpha: Whether to return alpha.
            depth: "expected", blended depth over alpha, 0 where empty; "accumulated", the sum of
                depth times blending weight; or None.
            normals: Whether to return normals.
            background: Background as red, green, blue, from 0 to 1.
            antialiased: Whether to fade Gaussians thinner than a pixel (Mip-Splatting); None for
                the scene's `antialiased`.
            dtype: uint8 or float32, of the colors.

        Raises:
            ArgumentError: a camera is invalid, or sizes differ.
        """
        single = isinstance(cameras, Camera)
        given: Any = cameras
        views: list[Camera] = list(given) if isinstance(given, Iterable) and not single else [given]
        for camera in views:
            if not isinstance(camera, Camera):
                raise ArgumentTypeError(f"cameras: found {camera!r}, expected a Camera or a sequence of cameras")
        sizes = {(camera.height, camera.width) for camera in views}
        if len(sizes) != 1:
            raise ArgumentError(f"cameras: found sizes {sorted(sizes)}, expected at least one camera, all of one size")
        kind = np.dtype(dtype)
        if kind not in (np.uint8, np.float32):
            raise ArgumentError(f"dtype: found {kind}, expected uint8 or float32")
        if depth is not None and depth not in _DEPTHS:
            raise ArgumentError(f"depth: found {depth!r}, expected 'expected', 'accumulated' or None")
        shape = (len(views), *sizes.pop())
        rgb = np.empty((*shape, 3), kind)
        alphas = np.empty(shape, np.float32) if alpha else None
        depths = np.empty(shape, np.float32) if depth else None
        normals_ = np.empty((*shape, 3), np.float32) if normals else None
        options = structure(
            "render_options",
            format=lib.ZS_PIXEL_RGB8 if kind == np.uint8 else lib.ZS_PIXEL_RGB_F32,
            depth=_DEPTHS[depth or "expected"],
            antialiasing=ANTIALIASING[antialiased],
            background=[float(value) for value in background],
        )
        arrays = {"pixels": rgb, "alpha": alphas, "depth": depths, "normals": normals_}
        call("zs_render", self._handle, native(views), structures("render_buffers", **arrays), len(views), options)
        planes = [None if array is None else array[0] if single else array for array in arrays.values()]
        return RenderOutput(*planes)  # type: ignore[arg-type]
