"""Models: networks that make scenes of photos."""

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
# Share of the progress that the reconstruction counts for where a refinement follows.
_RECONSTRUCTED = 0.2


class Model:
    """A network with its weights on a device. Any number of threads may reconstruct with it at the same time.

    Attributes:
        context: The device.
        picture_side: Side in pixels of the square pictures that it is best with.
        patch: Side of a patch in pixels: sizes of pictures are multiples of it.
        gaussians_per_token: Gaussians that a token becomes.
        sh_degree: Highest band of spherical harmonics of its scenes.
        precision: Number formats in use: "exact", "fast", "fast-bf16" or "turbo".
        weight_bytes: Bytes of its weights on the device.
        notes: Why it may be slow, and what was rounded or assumed to read the weights, in words.
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
            weights: "embedded", the demonstration that is built in; a checkpoint's path or bytes, safetensors or PyTorch; or
                "seeded:VARIANT", random numbers to try things out with.
            precision: "best", "exact", "fast", "fast-bf16" or "turbo".
            variant: The network of a checkpoint that does not say: "vitg", "vits", ...
            context: The device; None for the best.
            progress: Told the share that is done and what is under way. Where it returns False, CancelledError is raised; what it
                raises comes out of the call.

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
        """A scene of 1 to 192 photos of one place.

        Args:
            images: Photos: a folder, or a sequence of paths, encoded bytes, PIL images, arrays [height, width, 3 or 4] of uint8 from
                0 to 255 or float32 from 0 to 1 (NumPy, torch, or whatever has DLPack), or a Capture.
            cameras: Cameras of the whole photos, where they are known: a sequence of Camera, one for each, or a Capture or its path,
                in which photos are found by their names. None with a Capture for `images`, which has its own.
            ratio: Share of the tokens that become Gaussians, above 0 and up to 1; "auto" is 0.5 sqrt(2 / photos).
            refine: Steps of Scene.refine that follow; they need cameras.
            world: "first_camera": the scene's world is the first photo's camera, x right, y down, z forward. "cameras": the world of
                the cameras. "auto": the world of the cameras where there are any.
            unit: Length in the cameras' unit that the network takes for 1; "auto" finds it from the capture's points or the
                cameras. The scene keeps the cameras' unit.
            select: Which tokens are kept: "kmeans", the method's own, "stride" or "random".
            seed: For "random", and for the order of photos of a refinement.
            pool: For many photos: attention across them sees the mean of pool x pool patches in place of each, 1 to 4; more are faster
                and less exact.
            size: Width and height of what the network sees of each photo, multiples of `patch`: photos are cropped around their
                centre to this shape. None for the model's own.
            progress: Told the share that is done and what is under way. Where it returns False the work stops: CancelledError is
                raised, but from a refinement the best scene so far is returned. What it raises comes out of the call.

        Raises:
            ArgumentError, ValueError, TypeError: something given cannot be used.
            IoError, FormatError: a photo cannot be read.
            OutOfMemoryError, DeviceLostError, DriverError: the device.
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
