"""Scenes of a model, with their relation to the photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Optional, Union

import numpy as np
import numpy.typing as npt

from ._header import NUMBERS
from ._native import Handle, Owner, call, choose, lib, patch_tokens, structure, text, warned
from .cameras import Camera, from_native
from .device import Device
from .errors import ArgumentError
from .progress import Callback, ProgressFunction
from .scene import RefineTarget, Scene

Ratio = Union[float, Literal["auto"]]
TokenSelection = Literal["kmeans", "mutual", "stride", "random"]

_SELECTIONS: dict[TokenSelection, int] = {
    "kmeans": lib.ZS_TOKEN_SELECTION_KMEANS,
    "mutual": lib.ZS_TOKEN_SELECTION_MUTUAL,
    "stride": lib.ZS_TOKEN_SELECTION_STRIDE,
    "random": lib.ZS_TOKEN_SELECTION_RANDOM,
}


def number_or_auto(name: str, value: Union[float, Literal["auto"]], auto: float) -> float:
    """Returns a number above 0, or the library's number for "auto"."""
    if value == "auto":
        return auto
    if float(value) <= 0:
        raise ArgumentError(f"{name}: found {value!r}, expected a number above 0, or 'auto'")
    return float(value)


def selection_fields(ratio: Ratio, token_selection: TokenSelection, seed: int) -> dict[str, Any]:
    """Returns the library's options of ratio and selection."""
    return {
        "ratio": number_or_auto("ratio", ratio, NUMBERS["ZS_RATIO_AUTO"]),
        "token_selection": choose("token_selection", token_selection, _SELECTIONS),
        "seed": seed,
    }


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
        channel_count: Channels of `patch_tokens`; 0 without kept features.
        warnings: Messages about the photos and cameras.
    """

    def __init__(self, handle: Handle, device: Optional[Device], model: Handle) -> None:
        Owner.__init__(self, handle)
        self._model = model
        Scene.__init__(self, Handle("scene", "zs_reconstruction_to_scene", handle), device)
        info = structure("reconstruction_info")
        call("zs_reconstruction_get_info", handle, info)
        self._views: int = info.view_count
        self.token_count: int = info.token_count
        self.channel_count: int = info.channel_count
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

    def again(
        self,
        *,
        ratio: Ratio = 1.0,
        token_selection: TokenSelection = "kmeans",
        seed: int = 0,
        progress: Optional[ProgressFunction] = None,
    ) -> Reconstruction:
        """Reconstructs from the kept features, with the bits of Model.reconstruct and its arguments.

        Raises:
            ArgumentError: no features are kept, or an argument is invalid.

        Example:
            >>> scene = model.reconstruct("photos/", keep_features=True)
            >>> small = scene.again(ratio=0.25)
        """
        callback = Callback(progress)
        options = structure(
            "reconstruct_options", **selection_fields(ratio, token_selection, seed), **callback.fields
        )
        found = Handle("reconstruction", "zs_reconstruct_again", self._model, self._handle, options)
        return Reconstruction(found, self._device, self._model)

    @property
    def patch_tokens(self) -> npt.NDArray[np.float32]:
        """[photos, rows, columns, channel_count] patch tokens of the backbone's last layer.

        They cover the center of each photo in the shape of the network's input, as the pictures that
        `lift` takes.

        Raises:
            ArgumentError: no features are kept.
        """
        return patch_tokens("reconstruction", self._handle, self._views, self.channel_count)

    def _refined(self, device: Device, target: RefineTarget) -> tuple[Any, ...]:
        if target == "tokens":
            return "zs_refine_reconstruction", self._handle
        return super()._refined(device, target)
