"""Depth estimation: per-pixel depth and cameras of photos."""

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
    """Depth and cameras of photos.

    Attributes:
        depth: [photos, height, width] float32 along each camera's axis, in the cameras' scale,
            shared by all photos of a multi-view network.
        confidence: Same shape, at least 1, from multi-view networks; else None.
        sky: Same shape, at least 0 and above 0.3 for sky, from single-view networks; else None.
        cameras: Cameras of the whole photos, in a common world; None for unknown ones.
    """

    def __init__(self, handle: Handle, count: int, context: Context) -> None:
        self._handle, self.context = handle, context
        views = [self._view(index) for index in range(count)]
        self.depth: npt.NDArray[np.float32] = np.stack([view[0] for view in views])
        self.confidence: Optional[npt.NDArray[np.float32]] = _stacked([view[1] for view in views])
        self.sky: Optional[npt.NDArray[np.float32]] = _stacked([view[2] for view in views])
        self.cameras: list[Optional[Camera]] = [view[3] for view in views]

    def scene(self, *, keep: Optional[int] = None) -> Scene:
        """Creates a Gaussian per confident pixel, in the cameras' world.

        Args:
            keep: Limit per patch of 14 x 14 pixels, most visible first; None keeps all.

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
    """A Depth Anything 3 network with its weights on a device. Threads can share it.

    Attributes:
        context: Device of the network.
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
            weights: A released model.safetensors (da3-small, da3-base, ...), or random weights for
                "seeded:NAME".
            precision: "best", "exact", "fast", "fast-bf16" or "turbo".
            context: The device; None for the best.
            progress: Receives fraction and stage. Returning False raises CancelledError; its
                exceptions propagate.

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
        """Estimates depth of 1 to 192 photos of one place; multi-view networks also cameras.

        Args:
            images: Photos, as for Model.reconstruct.
            cameras: Known cameras of the whole photos, which set the depth scale.
            side: Longer side of the network's input in pixels.
            cameras_from: "decoder", or "rays", which also estimates the principal point.
            own_focal_lengths: Estimates a focal length per photo instead of one per photo size.
            progress: Receives fraction and stage. Returning False raises CancelledError; its
                exceptions propagate.

        Raises:
            ArgumentError, ValueError, TypeError: an argument is invalid.
            IoError, FormatError: a photo cannot be read.
            OutOfMemoryError, DeviceLostError, DriverError: the device failed.
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
