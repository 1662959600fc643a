"""Reconstructs scenes of 3D Gaussians from unposed photos, on any Vulkan device.

    import zipsplat

    model = zipsplat.Model.load()
    scene = model.reconstruct("photos/")
    scene.save("scene.ply")

Camera axes are OpenCV's: x right, y down, z forward. Matrix names state their direction
(camera_to_world, world_to_camera). Images are [height, width, channels]. Calls release the GIL.
"""

from ._native import lib as _lib
from ._native import text as _text
from .cameras import Camera, Cameras, Capture, CaptureView
from .command import Evaluation, ModelInfo, Page, estimate_cameras, evaluate, list_models
from .depth import DepthModel, DepthPrediction
from .device import Device, DeviceInfo, default_device, list_devices
from .errors import (
    ArgumentError,
    ArgumentTypeError,
    CancelledError,
    CommandError,
    DeviceLostError,
    DriverError,
    Error,
    FileError,
    ForkError,
    FormatError,
    InternalError,
    NoDeviceError,
    OutOfMemoryError,
    UnsupportedError,
    WeightsError,
)
from .gsplat import rasterization
from .images import list_images, load_image, save_image
from .model import Model
from .progress import Progress
from .reconstruction import CameraEstimate, Reconstruction
from .refine import RefineResult
from .renderer import Renderer, RenderOutput
from .scene import Scene

__version__: str = _text(_lib.zs_version())

__all__ = [
    "ArgumentError",
    "ArgumentTypeError",
    "Camera",
    "CameraEstimate",
    "Cameras",
    "CancelledError",
    "Capture",
    "CaptureView",
    "CommandError",
    "DepthModel",
    "DepthPrediction",
    "Device",
    "DeviceInfo",
    "DeviceLostError",
    "DriverError",
    "Error",
    "Evaluation",
    "FileError",
    "ForkError",
    "FormatError",
    "InternalError",
    "Model",
    "ModelInfo",
    "NoDeviceError",
    "OutOfMemoryError",
    "Page",
    "Progress",
    "Reconstruction",
    "RefineResult",
    "RenderOutput",
    "Renderer",
    "Scene",
    "UnsupportedError",
    "WeightsError",
    "default_device",
    "estimate_cameras",
    "evaluate",
    "list_devices",
    "list_images",
    "list_models",
    "load_image",
    "rasterization",
    "save_image",
]
