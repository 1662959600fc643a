"""Models: networks that reconstruct scenes from photos."""

from __future__ import annotations

import os
import re
from typing import Literal, Optional, Union

from . import command
from ._header import NUMBERS
from ._native import Handle, Owner, call, choose, ffi, lib, positive, structure, text, warned
from .cameras import PathLike
from .cameras import native as native_cameras
from .device import Device, DeviceLike, opened
from .images import CamerasLike, ImagesLike, MasksLike, matched
from .images import native as native_images
from .progress import Callback, ProgressFunction
from .reconstruction import Ratio, Reconstruction, TokenSelection, number_or_auto, selection_fields

Precision = Literal["auto", "fp32", "fp16", "bf16", "int8"]
World = Literal["auto", "first_camera", "input_cameras"]

PRECISIONS: dict[Precision, int] = {
    "auto": lib.ZS_PRECISION_AUTO,
    "fp32": lib.ZS_PRECISION_FP32,
    "fp16": lib.ZS_PRECISION_FP16,
    "bf16": lib.ZS_PRECISION_BF16,
    "int8": lib.ZS_PRECISION_INT8,
}
_WORLDS = {
    "auto": lib.ZS_WORLD_AUTO,
    "first_camera": lib.ZS_WORLD_FIRST_CAMERA,
    "input_cameras": lib.ZS_WORLD_INPUT_CAMERAS,
}


class Model(Owner):
    """A network with its weights on a device. Threads can share a model.

    Attributes:
        device: Device of the model.
        image_size: Native side of its square images, in pixels.
        patch_size: Side of a patch in pixels; image sides are multiples of it.
        gaussians_per_token: Gaussians per token.
        sh_degree: Degree of spherical harmonics of its scenes.
        precision: Number formats in use: "fp32", "fp16", "bf16" or "int8".
        weight_bytes: Bytes of weights on the device.
        warnings: Messages about speed and about assumptions made while loading.
    """

    def __init__(self, handle: Handle, device: Device) -> None:
        super().__init__(handle)
        self.device = device
        info = structure("model_info")
        call("zs_model_get_info", handle, info)
        self.image_size: int = info.image_size
        self.patch_size: int = info.patch_size
        self.gaussians_per_token: int = info.gaussians_per_token
        self.sh_degree: int = info.sh_degree
        self.precision: Precision = precision_name(info.precision)
        self.weight_bytes: int = info.weight_bytes
        self.warnings: list[str] = warned(text(info.warnings).splitlines())

    @classmethod
    def load(
        cls,
        weights: Union[PathLike, bytes] = "builtin",
        *,
        precision: Precision = "auto",
        variant: Optional[str] = None,
        tokens: bool = False,
        device: DeviceLike = None,
        progress: Optional[ProgressFunction] = None,
    ) -> Model:
        """Loads a checkpoint onto a device.

        Args:
            weights: "builtin" or another name of list_models, such as "zipsplat"; path or bytes of
                a safetensors or PyTorch checkpoint; or "seeded:VARIANT" for random weights.
            precision: "auto", "fp32", "fp16", "bf16" or "int8".
            variant: Variant of a checkpoint that does not name its own: "vitg", "vits", ...
            tokens: Keeps tokens of scenes on the device, for Reconstruction.refine.
            device: The device, as for Device; None for the best.
            progress: Called with the Progress. Returning False raises CancelledError; its
                exceptions propagate.

        Raises:
            NoDeviceError, WeightsError, FormatError, FileError, OutOfMemoryError, ArgumentError.

        Example:
            >>> model = Model.load("zipsplat", precision="fp16", device="cuda:0")
        """
        on, callback = opened(device), Callback(progress)
        name = ffi.NULL if variant is None else ffi.new("char[]", variant.encode())
        options = structure(
            "model_options",
            precision=choose("precision", precision, PRECISIONS),
            variant=name,
            tokens=int(tokens),
            **callback.fields,
        )
        if isinstance(weights, (bytes, bytearray, memoryview)):
            data = bytes(weights)
            return cls(Handle("model", "zs_model_from_memory", on._handle, data, len(data), options), on)
        return cls(Handle("model", "zs_model_load", on._handle, weights_path(weights), options), on)

    def reconstruct(
        self,
        images: ImagesLike,
        cameras: Optional[CamerasLike] = None,
        *,
        ratio: Ratio = 1.0,
        world: World = "auto",
        scene_scale: Union[float, Literal["auto"]] = "auto",
        token_selection: TokenSelection = "kmeans",
        seed: int = 0,
        kv_pool: Union[int, str] = 1,
        input_size: Optional[tuple[int, int]] = None,
        keep_features: bool = False,
        block_size: Optional[int] = None,
        block_overlap: Optional[int] = None,
        masks: Optional[MasksLike] = None,
        invert_masks: bool = False,
        progress: Optional[ProgressFunction] = None,
    ) -> Reconstruction:
        """Reconstructs a scene from photos of one place.

        Args:
            images: A folder, a Capture, or a sequence of paths, encoded bytes, PIL images or arrays
                (NumPy, torch, DLPack): [height, width, 3 or 4], uint8 or float32 from 0 to 1.
            cameras: Known cameras of the whole photos: a sequence of Camera, or a Capture or its
                path, with photos matched by name. None if `images` is a Capture.
            ratio: Fraction of tokens that become Gaussians, in (0, 1]; "auto" is
                0.5 sqrt(2 / photos).
            world: "first_camera" for the first photo's camera space, "input_cameras" for the world
                of the cameras, "auto" for theirs if known.
            scene_scale: Length in the cameras' unit that the network treats as 1; "auto" estimates
                it from the capture's points or the cameras.
            token_selection: Selection of kept tokens: "kmeans" as in the paper, "mutual" (nearest
                neighbors across photos), "stride" or "random".
            seed: Seed of "random".
            kv_pool: Keys and values of attention across views: 1 to 4 for means of so many patches
                squared, "local" for the own view only, "auto" for a rule by the number of views,
                "local/2" for the first block and the others; with "+own" and "+first", the own and
                the first view are whole. Fewer are faster and less exact.
            input_size: Width and height of the network's input, multiples of `patch_size`; photos
                are center-cropped. None for the model's own.
            keep_features: Whether to keep the backbone's features on the device, for
                Reconstruction.patch_tokens and Reconstruction.again.
            block_size: Most photos of a pass, up to 192; None for as many as the device's memory
                holds. More are split into overlapping blocks, by the cameras' positions or by order,
                and joined in one world. Features and tokens are kept of one block only.
            block_overlap: Photos that neighboring blocks share; None for a quarter of the block.
            masks: Pixels to ignore, where they are 0: a folder of PNGs of the photos' sizes and names
                (1.png or 1.jpg.png for 1.jpg), "alpha" for the photos' alpha channels, or an array
                [height, width] per image.
            invert_masks: Whether 0 keeps a pixel, and other values ignore it.
            progress: Called with the Progress. Returning False raises CancelledError; its
                exceptions propagate.

        Raises:
            ArgumentError: an argument is invalid.
            FileError, FormatError: a photo cannot be read.
            OutOfMemoryError, DeviceLostError, DriverError: the device failed.

        Example:
            >>> scene = model.reconstruct("photos/", ratio=0.5)
            >>> capture = Capture.open("capture/")
            >>> refined = model.reconstruct(capture).refine(capture, steps=200)
        """
        sources, posed, capture = matched(images, cameras)
        callback, known = Callback(progress), native_cameras(posed or ())
        pool = ffi.new("char[]", str(kv_pool).encode())
        options = structure(
            "reconstruct_options",
            **selection_fields(ratio, token_selection, seed),
            world=choose("world", world, _WORLDS),
            scene_scale=number_or_auto("scene_scale", scene_scale, NUMBERS["ZS_SCENE_SCALE_AUTO"]),
            input_size=(0, 0) if input_size is None else [positive("input_size", side) for side in input_size],
            kv_pool=pool,
            keep_features=keep_features,
            block_size=0 if block_size is None else positive("block_size", block_size),
            block_overlap=0 if block_overlap is None else positive("block_overlap", block_overlap),
            cameras=known,
            camera_count=len(known),
            capture=ffi.NULL if capture is None else capture._handle.pointer,
            **callback.fields,
        )
        photos, _kept = native_images(sources, masks, invert_masks)
        found = Handle("reconstruction", "zs_reconstruct", self._handle, photos, len(sources), options)
        return Reconstruction(found, self.device, self._handle)

    def __repr__(self) -> str:
        return f"<zipsplat.Model of {self.image_size}x{self.image_size} images on {self.device.info.name}>"


def precision_name(number: int) -> Precision:
    """Returns the name of a precision of the library."""
    return next(name for name, value in PRECISIONS.items() if value == number)


def weights_path(weights: PathLike) -> bytes:
    """Returns the path of weights, which may be a name of `list_models`."""
    path = os.fspath(weights)
    if path != "builtin" and re.fullmatch(r"[\w-]+", path) and not os.path.exists(path):
        path = command.run(["weights", "path", path])["path"]
    return os.fsencode(path)
