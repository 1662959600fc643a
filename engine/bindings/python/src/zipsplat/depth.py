"""Depth: networks that find how far away every pixel of photos is, and where the photos were taken."""

from __future__ import annotations

import os
from typing import Any, Optional

import numpy as np
import numpy.typing as npt

from ._native import Handle, Told, array_at, call, ffi, lib, options, structure
from ._native import progress as native_progress
from .cameras import Camera, PathLike, from_native
from .cameras import native as native_cameras
from .context import Context, default_context
from .images import Cameras, Images, matched
from .images import native as native_images
from .model import PRECISIONS, Progress, choose
from .scene import Scene

_CAMERAS_FROM = {"decoder": lib.ZS_CAMERAS_FROM_DECODER, "rays": lib.ZS_CAMERAS_FROM_RAYS}


class Depths:
    """Depth of photos, and the cameras that took them.

    Attributes:
        depth: [photos, height, width] float32 along each camera's axis, in one unit for all photos that were seen at once: that of the
            cameras.
        confidence: The same shape, from 1 on, where the network sees all photos at once; else None.
        sky: The same shape, from 0 on, above 0.3 sky, where the network sees each photo by itself; else None.
        cameras: The camera of each whole photo, in the world of all; None of a photo whose camera nobody knows.
    """

    def __init__(self, handle: Handle, count: int, context: Context) -> None:
        self._handle, self.context = handle, context
        views = [self._view(index) for index in range(count)]
        self.depth: npt.NDArray[np.float32] = np.stack([view[0] for view in views])
        self.confidence: Optional[npt.NDArray[np.float32]] = _stacked([view[1] for view in views])
        self.sky: Optional[npt.NDArray[np.float32]] = _stacked([view[2] for view in views])
        self.cameras: list[Optional[Camera]] = [view[3] for view in views]

    def scene(self, *, keep: Optional[int] = None) -> Scene:
        """A Gaussian for each pixel that the network is confident of, in the world of the cameras.

        Args:
            keep: At most so many of each patch of 14 x 14 pixels, those that show most; None for all.

        Raises:
            ArgumentError: no photo has a camera.
        """
        if keep is not None and keep < 1:
            raise ValueError(f"keep: found {keep}, expected a number above 0, or None")
        return Scene(Handle("scene", "zs_depths_scene", self._handle.pointer, keep or 0), self.context)

    def __repr__(self) -> str:
        photos, height, width = self.depth.shape
        return f"<zipsplat.Depths of {photos} photos at {width}x{height}>"

    def _view(self, index: int) -> tuple[Any, Any, Any, Optional[Camera]]:
        view, camera = structure("depth_view"), structure("camera")
        call("zs_depths_get", self._handle.pointer, index, view, camera)
        shape = (int(view.height), int(view.width))
        arrays = [
            array_at(self._handle, pointer, shape) if pointer else None
            for pointer in (view.depth, view.confidence, view.sky)
        ]
        return arrays[0], arrays[1], arrays[2], from_native(camera) if camera.width else None


def _stacked(views: list[Any]) -> Optional[npt.NDArray[np.float32]]:
    return None if views[0] is None else np.stack(views)


class DepthModel:
    """A network of Depth Anything 3 with its weights on a device. Any number of threads may use it at the same time.

    Attributes:
        context: The device.
    """

    def __init__(self, handle: Handle, context: Context) -> None:
        self._handle, self.context = handle, context

    @classmethod
    def open(
        cls,
        weights: PathLike,
        *,
        precision: str = "best",
        context: Optional[Context] = None,
        progress: Optional[Progress] = None,
    ) -> DepthModel:
        """Loads a network onto a device.

        Args:
            weights: A released file (model.safetensors of da3-small, da3-base, ...), or "seeded:NAME", random numbers to try things
                out with.
            precision: "best", "exact", "fast", "fast-bf16" or "turbo".
            context: The device; None for the best.
            progress: Told the share that is done and what is under way. Where it returns False, CancelledError is raised; what it
                raises comes out of the call.

        Raises:
            NoDeviceError, WeightsError, FormatError, IoError, OutOfMemoryError, ArgumentError.
        """
        context, told = context or default_context(), Told(progress)
        made = options("model", precision=choose("precision", precision, PRECISIONS))
        made.progress, made.user_data = native_progress, told.handle
        pointer = context._handle.pointer
        return cls(Handle("depth_model", "zs_depth_model_open", pointer, os.fsencode(weights), made), context)

    def depth(
        self,
        images: Images,
        cameras: Optional[Cameras] = None,
        *,
        side: int = 504,
        cameras_from: str = "decoder",
        own_focal_lengths: bool = False,
        progress: Optional[Progress] = None,
    ) -> Depths:
        """The depth of 1 to 192 photos of one place, and, with a network that sees all of them at once, the cameras that took them.

        Args:
            images: Photos, as Model.reconstruct takes them.
            cameras: Cameras of the whole photos, where they are known; depth is then in their unit.
            side: Longer side of the photos as the network sees them, in pixels.
            cameras_from: "decoder", the network's camera decoder, or "rays", those of all pixels, principal point included.
            own_focal_lengths: Whether photos of one size may have different focal lengths; else they share the median.
            progress: Told the share that is done and what is under way. Where it returns False, CancelledError is raised; what it
                raises comes out of the call.

        Raises:
            ArgumentError, ValueError, TypeError: something given cannot be used.
            IoError, FormatError: a photo cannot be read.
            OutOfMemoryError, DeviceLostError, DriverError: the device.
        """
        sources, posed, _capture = matched(images, cameras)
        told = Told(progress)
        made = options(
            "depth",
            side=side,
            cameras_from=choose("cameras_from", cameras_from, _CAMERAS_FROM),
            own_focal_lengths=int(own_focal_lengths),
            progress=native_progress,
            user_data=told.handle,
        )
        kept_cameras: Any = None
        if posed is not None:
            kept_cameras = native_cameras(posed)
            made.cameras, made.camera_count = kept_cameras, len(posed)
        photos, _kept = native_images(sources)
        found = Handle("depths", "zs_depth_find", self._handle.pointer, photos, len(sources), made)
        return Depths(found, len(sources), self.context)

    def __repr__(self) -> str:
        return f"<zipsplat.DepthModel on {self.context.device.name}>"
