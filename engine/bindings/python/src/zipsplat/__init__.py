"""Reconstructs scenes of 3D Gaussians from unposed photos, on any Vulkan device.

    import zipsplat

    model = zipsplat.Model.open()
    scene = model.reconstruct("photos/")
    scene.save("scene.ply")

Camera axes are OpenCV's: x right, y down, z forward. Matrix names state their direction
(camera_to_world, world_to_camera). Pictures are [height, width, channels]. Calls release the GIL.
"""

from ._native import lib as _lib
from ._native import text as _text
from .cameras import Camera, Capture, Photo, cameras
from .command import Evaluation, Page, evaluate, find_cameras
from .context import Context, Device, default_context, devices
from .depth import DepthModel, Depths
from .errors import (
    ArgumentError,
    CancelledError,
    CommandError,
    DeviceLostError,
    DriverError,
    Error,
    ForkError,
    FormatError,
    InternalError,
    IoError,
    NoDeviceError,
    OutOfMemoryError,
    UnsupportedError,
    WeightsError,
)
from .gsplat import rasterization
from .images import photos_in, read_photo, save_png
from .model import Model
from .renderer import Pictures, Renderer
from .scene import Refinement, Refining, Scene

__version__: str = _text(_lib.zs_version())

__all__ = [
    "ArgumentError",
    "Camera",
    "CancelledError",
    "Capture",
    "CommandError",
    "Context",
    "DepthModel",
    "Depths",
    "Device",
    "DeviceLostError",
    "DriverError",
    "Error",
    "Evaluation",
    "ForkError",
    "FormatError",
    "InternalError",
    "IoError",
    "Model",
    "NoDeviceError",
    "OutOfMemoryError",
    "Page",
    "Photo",
    "Pictures",
    "Refinement",
    "Refining",
    "Renderer",
    "Scene",
    "UnsupportedError",
    "WeightsError",
    "cameras",
    "default_context",
    "devices",
    "evaluate",
    "find_cameras",
    "photos_in",
    "rasterization",
    "read_photo",
    "save_png",
]
