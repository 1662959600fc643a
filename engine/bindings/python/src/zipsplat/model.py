"""Models: networks that reconstruct scenes from photos."""

from __future__ import annotations

import os
from typing import Any, Callable, Optional, Union

from ._native import NUMBERS, Handle, Told, call, ffi, lib, options, structure, text
from ._native import progress as native_progress
from .cameras import PathLike
from .cameras import native as native_cameras
from .context import Context, default_context
from .images import Cameras, Images, matched
from .images import native as native_images
from .scene import Refining, Scene, relative

Progress = Callable[[float, str], Optional[bool]]

PRECISIONS = {
    "best": lib.ZS_PRECISION_BEST,
    "exact": lib.ZS_PRECISION_EXACT,
    "fast": lib.ZS_PRECISION_FAST,
    "fast-bf16": lib.ZS_PRECISION_FAST_BF16,
    "turbo": lib.ZS_PRECISION_TURBO,
}
_SELECTIONS = {"kmeans": lib.ZS_SELECT_KMEANS, "stride": lib.ZS_SELECT_STRIDE, "random": lib.ZS_SELECT_RANDOM}
_WORLDS = {"first_camera": lib.ZS_WORLD_FIRST_CAMERA, "cameras": lib.ZS_WORLD_CAMERAS}
# Fraction of the progress for reconstruction before a refinement.
_RECONSTRUCTED = 0.2


class Model:
    """A network with its weights on a device. Threads can share a model.

    Attributes:
        context: Device of the model.
        picture_side: Native side of its square pictures, in pixels.
        patch: Side of a patch in pixels; picture sides are multiples of it.
        gaussians_per_token: Gaussians per token.
        sh_degree: Degree of spherical harmonics of its scenes.
        precision: Number formats in use: "exact", "fast", "fast-bf16" or "turbo".
        weight_bytes: Bytes of weights on the device.
        notes: Warnings about speed and about assumptions made while loading.
    """

    def __init__(self, handle: Handle, context: Context) -> None:
        self._handle, self.context = handle, context
        info = structure("model_info")
        call("zs_model_get_info", handle.pointer, info)
        self.picture_side: int = info.picture_side
        self.patch: int = info.patch
        self.gaussians_per_token: int = info.gaussians_per_token
        self.sh_degree: int = info.sh_degree
        self.precision = next(name for name, number in PRECISIONS.items() if number == info.precision)
        self.weight_bytes: int = info.weight_bytes
        self.notes: list[str] = text(info.notes).splitlines()

    @classmethod
    def open(
        cls,
        weights: Union[PathLike, bytes] = "embedded",
        *,
        precision: str = "best",
        variant: Optional[str] = None,
        context: Optional[Context] = None,
        progress: Optional[Progress] = None,
    ) -> Model:
        """Loads a checkpoint onto a device.

        Args:
            weights: "embedded" for the built-in model; path or bytes of a safetensors or PyTorch
                checkpoint; or "seeded:VARIANT" for random weights.
            precision: "best", "exact", "fast", "fast-bf16" or "turbo".
            variant: Variant of a checkpoint that does not name its own: "vitg", "vits", ...
            context: The device; None for the best.
            progress: Receives fraction and stage. Returning False raises CancelledError; its
                exceptions propagate.

        Raises:
            NoDeviceError, WeightsError, FormatError, IoError, OutOfMemoryError, ArgumentError.
        """
        context, told = context or default_context(), Told(progress)
        made = options("model", precision=choose("precision", precision, PRECISIONS))
        name = ffi.NULL if variant is None else ffi.new("char[]", variant.encode())
        made.variant, made.progress, made.user_data = name, native_progress, told.handle
        pointer = context._handle.pointer
        if isinstance(weights, (bytes, bytearray, memoryview)):
            data = bytes(weights)
            return cls(Handle("model", "zs_model_from_memory", pointer, data, len(data), made), context)
        return cls(Handle("model", "zs_model_open", pointer, os.fsencode(weights), made), context)

    def reconstruct(
        self,
        images: Images,
        cameras: Optional[Cameras] = None,
        *,
        ratio: Union[float, str] = 1.0,
        refine: int = 0,
        world: str = "auto",
        unit: Union[float, str] = "auto",
        select: str = "kmeans",
        seed: int = 0,
        pool: int = 1,
        size: Optional[tuple[int, int]] = None,
        progress: Optional[Progress] = None,
    ) -> Scene:
        """Reconstructs a scene from 1 to 192 photos of one place.

        Args:
            images: A folder, a Capture, or a sequence of paths, encoded bytes, PIL images or arrays
                (NumPy, torch, DLPack): [height, width, 3 or 4], uint8 or float32 from 0 to 1.
            cameras: Known cameras of the whole photos: a sequence of Camera, or a Capture or its
                path, with photos matched by name. None if `images` is a Capture.
            ratio: Fraction of tokens that become Gaussians, in (0, 1]; "auto" is
                0.5 sqrt(2 / photos).
            refine: Steps of Scene.refine afterwards; they need cameras.
            world: "first_camera" for the first photo's camera space, "cameras" for the cameras'
                world, "auto" for the cameras' world if known.
            unit: Scene scale: the length in the cameras' unit that the network treats as 1; "auto"
                estimates it from the capture's points or the cameras.
            select: Selection of kept tokens: "kmeans" as in the paper, "stride" or "random".
            seed: Seed of "random" and of a refinement's photo order.
            pool: Pooling for many photos: cross-view attention reads means of pool x pool patches,
                1 to 4. Larger values are faster and less exact.
            size: Width and height of the network's input, multiples of `patch`; photos are
                center-cropped. None for the model's own.
            progress: Receives fraction and stage. Returning False raises CancelledError, or ends a
                refinement early with its best scene. Its exceptions propagate.

        Raises:
            ArgumentError, ValueError, TypeError: an argument is invalid.
            IoError, FormatError: a photo cannot be read.
            OutOfMemoryError, DeviceLostError, DriverError: the device failed.
        """
        sources, posed, capture = matched(images, cameras)
        if refine and posed is None:
            raise ValueError("refine: found no cameras, expected one for each image; zipsplat.find_cameras finds them")
        if world == "auto":
            world = "first_camera" if posed is None else "cameras"
        share = _RECONSTRUCTED if refine else 1.0
        told = Told(None if progress is None else lambda done, stage: progress(share * done, stage))
        width, height = (0, 0) if size is None else size
        made = options(
            "reconstruct",
            world=choose("world", world, _WORLDS),
            ratio=NUMBERS["ZS_RATIO_AUTO"] if ratio == "auto" else float(ratio),
            unit=NUMBERS["ZS_UNIT_AUTO"] if unit == "auto" else float(unit),
            selection=choose("select", select, _SELECTIONS),
            width=width,
            height=height,
            seed=seed,
            pool=pool,
            progress=native_progress,
            user_data=told.handle,
        )
        if ratio != "auto" and float(ratio) == NUMBERS["ZS_RATIO_AUTO"] or unit != "auto" and float(unit) <= 0:
            raise ValueError(f"found ratio {ratio!r} and unit {unit!r}, expected numbers above 0, or 'auto'")
        kept_cameras: Any = None
        if posed is not None:
            kept_cameras = native_cameras(posed)
            made.cameras, made.camera_count = kept_cameras, len(posed)
        if capture is not None:
            made.capture = capture._handle.pointer
        photos, kept = native_images(sources)
        scene = Scene(Handle("scene", "zs_reconstruct", self._handle.pointer, photos, len(sources), made), self.context)
        if not refine or posed is None:
            return scene
        tell = None if progress is None else _refining_as(progress)
        where = posed if world == "cameras" else relative(posed)
        return scene.refine(kept, where, steps=refine, seed=seed, progress=tell, context=self.context)

    def __repr__(self) -> str:
        return f"<zipsplat.Model of {self.picture_side}x{self.picture_side} pictures on {self.context.device.name}>"


def _refining_as(progress: Progress) -> Callable[[Refining], Optional[bool]]:
    def tell(now: Refining) -> Optional[bool]:
        return progress(_RECONSTRUCTED + (1 - _RECONSTRUCTED) * now.step / max(now.steps, 1), "refine")

    return tell


def choose(name: str, found: str, names: dict[str, int]) -> int:
    if found not in names:
        raise ValueError(f"{name}: found {found!r}, expected one of {', '.join(map(repr, names))}")
    return names[found]
