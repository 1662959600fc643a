"""Scenes of a model, with their relation to the photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Optional

from ._native import Handle, Owner, call, structure, text, warned
from .cameras import Camera, from_native
from .device import Device
from .scene import RefineTarget, Scene


@dataclass(frozen=True)
class CameraEstimate:
    """Camera of a photo, estimated from a reconstruction.

    Attributes:
        camera: Camera of the whole photo in the scene's world; None without an estimate.
        inliers: Number of patches that agree with the camera.
        patches: Number of patches.
    """

    camera: Optional[Camera]
    inliers: int
    patches: int


class Reconstruction(Owner, Scene):
    """A scene of Model.reconstruct, with its relation to the photos, kept on the model's device.

    Closing frees the memory on the device; the scene stays usable.

    Attributes:
        token_count: Number of kept tokens.
        warnings: Messages about the photos and cameras.
    """

    def __init__(self, handle: Handle, device: Device) -> None:
        Owner.__init__(self, handle)
        Scene.__init__(self, Handle("scene", "zs_reconstruction_to_scene", handle), device)
        info = structure("reconstruction_info")
        call("zs_reconstruction_get_info", handle, info)
        self._views: int = info.view_count
        self.token_count: int = info.token_count
        self.warnings: list[str] = warned(text(info.warnings).splitlines())

    def estimate_cameras(self) -> list[CameraEstimate]:
        """Estimates the cameras of unposed photos from the Gaussians of their patches.

        They share a field of view.

        Raises:
            Error: no photo has an estimate, or the cameras are known.

        Example:
            >>> estimates = model.reconstruct("photos/").estimate_cameras()
            >>> scene.render(estimates[0].camera)
        """
        estimates = []
        for index in range(self._views):
            found = structure("camera_estimate")
            call("zs_reconstruction_estimate_camera", self._handle, index, found)
            camera = from_native(found.camera) if found.camera else None
            estimates.append(CameraEstimate(camera, found.inliers, found.patches))
        return estimates

    def _refined(self, device: Device, target: RefineTarget) -> tuple[Any, ...]:
        if target == "tokens":
            return "zs_refine_reconstruction", self._handle
        return super()._refined(device, target)
