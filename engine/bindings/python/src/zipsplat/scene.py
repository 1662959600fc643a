"""Scenes: 3D Gaussians in memory, from and to arrays and files."""

from __future__ import annotations

import html
import math
import os
from dataclasses import dataclass
from typing import Any, Callable, Optional, Sequence, Union

import numpy as np
import numpy.typing as npt

from . import command
from ._native import Handle, Told, array_at, call, ffi, lib, options, refine_progress, structure
from .cameras import Camera, PathLike
from .cameras import native as native_cameras
from .context import Context, default_context
from .images import Cameras, Images, matched
from .images import native as native_images

Array = npt.NDArray[np.float32]
FIELDS = ("means", "scales", "quats", "opacities", "sh_coeffs")


@dataclass(frozen=True)
class Refinement:
    """The outcome of a refinement.

    Attributes:
        ended: Why it ended: "finished", "stopped" by the progress function, or "diverged".
        steps: Steps that were taken.
        best_step: The step after which the scene was kept; 0 where none made it better.
        first_loss: Mean loss of the photos of the first step; NaN where there was none.
        last_loss: Mean loss of the photos of the last step; NaN where there was none.
        psnr_before: PSNR in dB of the held-out photos before the first step; NaN where none are held out.
        psnr: The same with the scene that was kept.
        seconds: Seconds that it took.
    """

    ended: str
    steps: int
    best_step: int
    first_loss: float
    last_loss: float
    psnr_before: float
    psnr: float
    seconds: float


@dataclass(frozen=True)
class Refining:
    """How far a refinement is.

    Attributes:
        step: Steps that are done.
        steps: All steps.
        loss: Mean loss of the photos of the last step.
        psnr: PSNR in dB of the held-out photos, when they were looked at last; NaN where none are held out.
        seconds_left: Seconds that are left, as steps took so far.
    """

    step: int
    steps: int
    loss: float
    psnr: float
    seconds_left: float


class Scene:
    """3D Gaussians in host memory. A scene never changes, so any number of threads may use it; it outlives devices. The world has
    axes x right, y down, z forward.

    Attributes:
        means: [N, 3] float32 centres, world units.
        scales: [N, 3] float32 standard deviations along the Gaussian's own axes, world units: linear, not logarithms.
        quats: [N, 4] float32 rotations w, x, y, z; of any length but zero.
        opacities: [N] float32 from 0 to 1.
        sh_coeffs: [N, K, 3] float32 coefficients of spherical harmonics for red, green, blue, as 3D Gaussian Splatting's files
            have them; K = (sh_degree + 1) ** 2.
        sh_degree: The highest band, 0 to 3.
        refinement: What came of the refinement that made it; None where none did.

    The arrays lie in the library's memory: they are not copied, cannot be written, and keep what they need alive.
    """

    def __init__(
        self, handle: Handle, context: Optional[Context] = None, refinement: Optional[Refinement] = None
    ) -> None:
        self._handle, self._context, self.refinement = handle, context, refinement
        found = structure("gaussians")
        call("zs_scene_get_gaussians", handle.pointer, found)
        count = int(found.count)
        self.sh_degree: int = found.sh_degree
        self.means: Array = array_at(handle, found.means, (count, 3))
        self.scales: Array = array_at(handle, found.scales, (count, 3))
        self.quats: Array = array_at(handle, found.quats, (count, 4))
        self.opacities: Array = array_at(handle, found.opacities, (count,))
        self.sh_coeffs: Array = array_at(handle, found.sh_coeffs, (count, (self.sh_degree + 1) ** 2, 3))

    @classmethod
    def open(cls, path: PathLike, *, drop_invalid: bool = False) -> Scene:
        """Reads a scene file: PLY, also packed (.compressed.ply), SPZ, .splat, glTF with KHR_gaussian_splatting (.gltf, .glb).
        Whatever axes the format has, the scene's are x right, y down, z forward.

        Args:
            path: The file.
            drop_invalid: Leaves out Gaussians with values that are NaN, infinite or out of range, and does not refuse the file.
        """
        if drop_invalid:
            return cls(Handle("scene", "zs_scene_open_dropping_invalid", os.fsencode(path), ffi.NULL))
        return cls(Handle("scene", "zs_scene_open", os.fsencode(path)))

    @classmethod
    def from_bytes(cls, data: bytes, format: Optional[str] = None, *, drop_invalid: bool = False) -> Scene:
        """As `open`, with a file's contents. PLY, SPZ and .glb are told apart by their first bytes; `format` names one that they do
        not tell: "splat" or "gltf"."""
        dropped = ffi.new("uint64_t *") if drop_invalid else ffi.NULL
        return cls(Handle("scene", "zs_scene_from_memory", data, len(data), _name(format), dropped))

    @classmethod
    def from_arrays(
        cls,
        means: npt.ArrayLike,
        scales: npt.ArrayLike,
        quats: npt.ArrayLike,
        opacities: npt.ArrayLike,
        sh_coeffs: npt.ArrayLike,
    ) -> Scene:
        """A scene of a copy of arrays, shaped as the attributes are. NumPy's, or what NumPy makes one of.

        Raises:
            ValueError, ArgumentError: a shape is not that, or a value is not finite or out of range.
        """
        arrays = [np.ascontiguousarray(array, np.float32) for array in (means, scales, quats, opacities, sh_coeffs)]
        count = len(arrays[0]) if arrays[0].ndim else 0
        bands = math.isqrt(arrays[4].shape[1]) if arrays[4].ndim == 3 else 1
        shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, bands**2, 3)]
        for name, array, shape in zip(FIELDS, arrays, shapes):
            if array.shape != shape:
                raise ValueError(f"{name}: found shape {list(array.shape)}, expected {list(shape)}")
        pointers = {name: ffi.cast("float *", array.ctypes.data) for name, array in zip(FIELDS, arrays)}
        found = structure("gaussians", count=count, sh_degree=bands - 1, **pointers)
        return cls(Handle("scene", "zs_scene_create", found))

    def save(self, path: PathLike, *, spz_version: int = 3) -> None:
        """Writes the scene in the format of the path's extension: .ply, .spz, .splat, .gltf or .glb. The file appears whole or not
        at all; one of that name is replaced.

        Args:
            path: The file.
            spz_version: Version of an SPZ: 3; 2 for older readers; 4 for those that know only the newest.
        """
        call("zs_scene_save", self._handle.pointer, os.fsencode(path), options("save", spz_version=spz_version))

    def to_bytes(self, format: str, *, spz_version: int = 3) -> bytes:
        """What the file of a format would have: "ply", "spz", "splat", "gltf" or "glb"."""
        made = options("save", spz_version=spz_version)
        found = Handle("bytes", "zs_scene_to_memory", self._handle.pointer, _name(format), made)
        data, size = ffi.new("void **"), ffi.new("size_t *")
        call("zs_bytes_get", found.pointer, data, size)
        return bytes(ffi.buffer(data[0], size[0]))

    def refine(
        self,
        images: Images,
        cameras: Optional[Cameras] = None,
        *,
        steps: int = 100,
        views_per_step: int = 4,
        hold_out: Union[int, str] = "auto",
        size: Optional[tuple[int, int]] = (1600, 1600),
        seed: int = 0,
        progress: Optional[Callable[[Refining], Optional[bool]]] = None,
        context: Optional[Context] = None,
    ) -> Scene:
        """The scene made sharp: its Gaussians moved until each photo is what its camera sees.

        Args:
            images: Photos, as Model.reconstruct takes them.
            cameras: Their cameras, in the scene's world; none with a Capture.
            steps: Steps of the optimiser.
            views_per_step: Photos of a step.
            hold_out: Photos that nothing is learnt from, evenly spread: the scene is that of the step that predicts them best.
                "auto" is 1 of 9 or more.
            size: Most pixels of a photo along x and y: a larger one is compared at the largest size that fits; None for photos as
                they are.
            seed: Of the order of the photos: the same seed, the same scene.
            progress: Told how far it is after each step. Where it returns False the refinement ends, which is no failure: the scene
                is the best so far. What it raises comes out of the call.
            context: The device; None for the one that the scene was made on, or the best.

        Returns:
            A scene of its own, with what came of it in `refinement`.
        """
        sources, posed, _ = matched(images, cameras)
        if posed is None:
            raise ValueError("cameras: found none, expected one for each image; zipsplat.find_cameras finds them")
        context = context or self._context or default_context()
        photos, _kept = native_images(sources)
        told = Told(None if progress is None else lambda now: progress(_refining(now)))
        width, height = (0, 0) if size is None else size
        made = options(
            "refine",
            steps=steps,
            views_per_step=views_per_step,
            hold_out=lib.ZS_HOLD_OUT_AUTO if hold_out == "auto" else int(hold_out),
            width=width,
            height=height,
            seed=seed,
            progress=refine_progress,
            user_data=told.handle,
        )
        info, pointer = structure("refine_info"), self._handle.pointer
        arguments = (context._handle.pointer, pointer, photos, native_cameras(posed), len(sources), made, info)
        return Scene(Handle("scene", "zs_refine", *arguments), context, _refinement(info))

    def render(self, cameras: Any, **how: Any) -> Any:
        """Pictures of the scene: `Renderer(scene).render(cameras, ...)`. For many calls keep a Renderer."""
        from .renderer import Renderer

        return Renderer(self).render(cameras, **how)

    def show(self, height: int = 600, *, cameras: Optional[PathLike] = None) -> command.Page:
        """The scene in a notebook, to look around in: what `zipsplat view -o` writes, in a frame.

        Args:
            height: Pixels of the frame.
            cameras: A transforms.json or COLMAP model in the scene's world, to look through.

        Raises:
            CommandError: the command `zipsplat` is not installed, or fails.
        """
        return command.view(self.to_bytes("ply"), height, cameras)

    def __len__(self) -> int:
        return len(self.means)

    def __reduce__(self) -> tuple[Any, ...]:
        return Scene.from_arrays, tuple(np.asarray(getattr(self, name)) for name in FIELDS)

    def __repr__(self) -> str:
        return f"<zipsplat.Scene of {len(self):,} Gaussians, degree {self.sh_degree}>"

    def _repr_html_(self) -> str:
        rows = [("Gaussians", f"{len(self):,}"), ("spherical harmonics", f"degree {self.sh_degree}")]
        if len(self):
            ends = [self.means.min(axis=0), self.means.max(axis=0)]
            rows += [(axis, f"{low:.3g} to {high:.3g}") for axis, low, high in zip("xyz", *ends)]
        cells = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in rows)
        return f"<table>{cells}</table>"


def _name(format: Optional[str]) -> Any:
    return ffi.NULL if format is None else ffi.new("char[]", format.encode())


def _refining(now: Any) -> Refining:
    return Refining(now.step, now.steps, now.loss, now.psnr, now.seconds_left)


def _refinement(info: Any) -> Refinement:
    ended = {lib.ZS_REFINE_FINISHED: "finished", lib.ZS_REFINE_STOPPED: "stopped", lib.ZS_REFINE_DIVERGED: "diverged"}
    losses = (info.first_loss, info.last_loss)
    return Refinement(ended[info.ended], info.steps, info.best_step, *losses, info.psnr_before, info.psnr, info.seconds)


def relative(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras in the world of the first of them."""
    return [camera.relative_to(cameras[0]) for camera in cameras]
