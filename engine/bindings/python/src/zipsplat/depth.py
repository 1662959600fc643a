"""Depth estimation: per-pixel depth and cameras of photos."""

from __future__ import annotations

from typing import Any, Literal, Optional, Sequence

import numpy as np
import numpy.typing as npt

from ._native import Handle, Owner, array_at, call, choose, lib, patch_tokens, positive, structure, text, warned
from .cameras import Camera, PathLike, from_native
from .cameras import native as native_cameras
from .device import Device, DeviceLike, opened
from .images import CamerasLike, ImagesLike, matched
from .images import native as native_images
from .model import PRECISIONS, Precision, precision_name, weights_path
from .progress import Callback, ProgressFunction
from .scene import Scene

CameraSource = Literal["decoder", "rays"]
_CAMERA_SOURCES = {"decoder": lib.ZS_CAMERA_SOURCE_DECODER, "rays": lib.ZS_CAMERA_SOURCE_RAYS}


class DepthPrediction:
    """Depth and cameras of photos.

    Attributes:
        depth: [photos, height, width] float32 along each camera's axis, in the cameras' scale,
            shared by all photos of a multi-view network.
        confidence: Same shape, at least 1, from multi-view networks; else None.
        sky: Same shape, at least 0 and above 0.3 for sky, from single-view networks; else None.
        cameras: Cameras of the depth maps, which unproject them, in a common world; None for
            unknown ones.
        image_cameras: Cameras of the whole photos; None for unknown ones.
        patch_tokens: [photos, rows, columns, channels] patch tokens of the backbone's last layer,
            for Scene.lift with `cameras`; None unless kept.
    """

    def __init__(self, handle: Handle, count: int, device: Device) -> None:
        self._handle, self.device = handle, device
        views = [self._view(index) for index in range(count)]
        depth, confidence, sky, cameras, image_cameras = zip(*views)
        self.depth: npt.NDArray[np.float32] = np.stack(depth)
        self.confidence: Optional[npt.NDArray[np.float32]] = _stacked(confidence)
        self.sky: Optional[npt.NDArray[np.float32]] = _stacked(sky)
        self.cameras: list[Optional[Camera]] = list(cameras)
        self.image_cameras: list[Optional[Camera]] = list(image_cameras)
        info = structure("depth_result_info")
        call("zs_depth_result_get_info", handle, info)
        channels: int = info.channel_count
        self.patch_tokens: Optional[npt.NDArray[np.float32]] = (
            patch_tokens("depth_result", handle, count, channels) if channels else None
        )

    def to_scene(self, *, max_gaussians_per_patch: Optional[int] = None) -> Scene:
        """Creates a Gaussian per confident pixel, in the cameras' world.

        Args:
            max_gaussians_per_patch: Limit per patch of 14 x 14 pixels, most visible first; None
                keeps all.

        Raises:
            ArgumentError: no photo has a camera.
        """
        limit = 0 if max_gaussians_per_patch is None else positive("max_gaussians_per_patch", max_gaussians_per_patch)
        return Scene(Handle("scene", "zs_depth_result_to_scene", self._handle, limit), self.device)

    def __repr__(self) -> str:
        photos, height, width = self.depth.shape
        return f"<zipsplat.DepthPrediction of {photos} photos at {width}x{height}>"

    def _view(self, index: int) -> tuple[Any, ...]:
        view = structure("depth_map")
        call("zs_depth_result_get_map", self._handle, index, view)
        shape = (int(view.height), int(view.width))
        arrays = (view.depth, view.confidence, view.sky)
        cameras = (view.camera, view.image_camera)
        return (
            *(array_at(self._handle, pointer, shape) if pointer else None for pointer in arrays),
            *(from_native(pointer) if pointer else None for pointer in cameras),
        )


def _stacked(views: Sequence[Any]) -> Optional[npt.NDArray[np.float32]]:
    return None if views[0] is None else np.stack(views)


class DepthModel(Owner):
    """A Depth Anything 3 or VGGT network with its weights on a device. Threads can share it.

    Attributes:
        device: Device of the network.
        is_multi_view: Whether it sees all photos at once and estimates cameras.
        patch_size: Side of a patch in pixels; sides of maps are multiples of it.
        precision: Number formats in use: "fp32", "fp16", "bf16" or "int8".
        weight_bytes: Bytes of weights on the device.
        warnings: Messages about speed.
    """

    def __init__(self, handle: Handle, device: Device) -> None:
        super().__init__(handle)
        self.device = device
        info = structure("depth_model_info")
        call("zs_depth_model_get_info", handle, info)
        self.is_multi_view = bool(info.is_multi_view)
        self.patch_size: int = info.patch_size
        self.precision: Precision = precision_name(info.precision)
        self.weight_bytes: int = info.weight_bytes
        self.warnings: list[str] = warned(text(info.warnings).splitlines())

    @classmethod
    def load(
        cls,
        weights: PathLike,
        *,
        precision: Precision = "auto",
        device: DeviceLike = None,
        progress: Optional[ProgressFunction] = None,
    ) -> DepthModel:
        """Loads a network onto a device.

        Args:
            weights: A name of list_models, such as "da3-small"; path of a released
                model.safetensors or model.pt; or "seeded:NAME" for random weights.
            precision: "auto", "fp32", "fp16", "bf16" or "int8".
            device: The device, as for Device; None for the best.
            progress: Called with the Progress. Returning False raises CancelledError; its
                exceptions propagate.

        Raises:
            NoDeviceError, WeightsError, FormatError, FileError, OutOfMemoryError, ArgumentError.
        """
        on, callback = opened(device), Callback(progress)
        number = choose("precision", precision, PRECISIONS)
        options = structure("depth_model_options", precision=number, **callback.fields)
        return cls(Handle("depth_model", "zs_depth_model_load", on._handle, weights_path(weights), options), on)

    def predict(
        self,
        images: ImagesLike,
        cameras: Optional[CamerasLike] = None,
        *,
        input_size: Optional[int] = None,
        camera_source: CameraSource = "decoder",
        per_view_focal: bool = False,
        keep_features: bool = False,
        progress: Optional[ProgressFunction] = None,
    ) -> DepthPrediction:
        """Estimates depth of 1 to 192 photos of one place; multi-view networks also cameras.

        Args:
            images: Photos, as for Model.reconstruct.
            cameras: Known cameras of the whole photos, which set the depth scale.
            input_size: Longer side of the network's input in pixels, 504 by default; for VGGT its
                width, 518 by default.
            camera_source: "decoder", or "rays", which also estimates the principal point.
            per_view_focal: Estimates a focal length per photo instead of one per photo size.
            keep_features: Whether to return patch_tokens.
            progress: Called with the Progress. Returning False raises CancelledError; its
                exceptions propagate.

        Raises:
            ArgumentError: an argument is invalid.
            FileError, FormatError: a photo cannot be read.
            OutOfMemoryError, DeviceLostError, DriverError: the device failed.

        Example:
            >>> prediction = DepthModel.load("da3-small").predict("photos/")
            >>> prediction.depth.shape
            (12, 378, 504)
        """
        sources, posed, _capture = matched(images, cameras)
        callback, known = Callback(progress), native_cameras(posed or ())
        options = structure(
            "depth_options",
            input_size=0 if input_size is None else positive("input_size", input_size),
            camera_source=choose("camera_source", camera_source, _CAMERA_SOURCES),
            per_view_focal=int(per_view_focal),
            keep_features=int(keep_features),
            cameras=known,
            camera_count=len(known),
            **callback.fields,
        )
        photos, _kept = native_images(sources)
        found = Handle("depth_result", "zs_depth_predict", self._handle, photos, len(sources), options)
        return DepthPrediction(found, len(sources), self.device)

    def __repr__(self) -> str:
        return f"<zipsplat.DepthModel on {self.device.info.name}>"
