"""Scenes: 3D Gaussians from and to arrays, files and bytes."""

from __future__ import annotations

import html
import math
import os
from typing import TYPE_CHECKING, Any, Literal, Mapping, Optional, Sequence, Tuple, Union, get_args

import numpy as np
import numpy.typing as npt

from . import command
from ._native import Handle, array_at, call, choose, ffi, lib, positive, structure
from .cameras import Camera, PathLike
from .cameras import native as native_cameras
from .device import Device, DeviceLike, TorchDevice, opened
from .errors import ArgumentError, ArgumentTypeError
from .images import CamerasLike, DepthsLike, ImagesLike, MasksLike, posed
from .images import native as native_images
from .progress import Callback, ProgressFunction
from .refine import RefineResult, refine_result

if TYPE_CHECKING:
    import torch

    from .renderer import DepthMode, RenderOutput

Array = npt.NDArray[np.float32]
Format = Literal["ply", "spz", "sog", "splat", "gltf", "glb"]
World = Literal["first_camera", "input_cameras"]
SpzVersion = Literal[2, 3, 4]
RefineTarget = Literal["gaussians", "tokens"]
ExposureMode = Literal["auto", "off", "on"]
DepthKind = Literal["metric", "relative"]
EditName = Literal[
    "crop_box",
    "crop_sphere",
    "translate",
    "rotate",
    "scale",
    "level",
    "min_opacity",
    "max_size",
    "min_neighbors",
    "min_views",
    "clean",
    "sh_degree",
    "decimate",
    "sort",
]
Edit = Union[EditName, Tuple[EditName, Union[float, Sequence[float]]]]
FIELDS = ("means", "scales", "quats", "opacities", "sh_coeffs")
_WORLDS: dict[int, World] = {
    lib.ZS_WORLD_FIRST_CAMERA: "first_camera",
    lib.ZS_WORLD_INPUT_CAMERAS: "input_cameras",
}
_REFINE_TARGETS = {"gaussians": lib.ZS_REFINE_TARGET_GAUSSIANS, "tokens": lib.ZS_REFINE_TARGET_TOKENS}
_EXPOSURE_MODES = {name: getattr(lib, f"ZS_EXPOSURE_{name.upper()}") for name in get_args(ExposureMode)}
_DEPTH_KINDS = {name: getattr(lib, f"ZS_DEPTH_LOSS_{name.upper()}") for name in get_args(DepthKind)}
ANTIALIASING = {None: lib.ZS_ANTIALIASING_AUTO, True: lib.ZS_ANTIALIASING_ON, False: lib.ZS_ANTIALIASING_OFF}
_EDITS = {name: getattr(lib, f"ZS_EDIT_{name.upper()}") for name in get_args(EditName)}
# Least scale and distance of opacities from 0 and 1 with finite logarithms, in float32.
_LEAST_SCALE, _LEAST_OPACITY = 1e-30, 1e-7


class Scene:
    """Immutable 3D Gaussians in host memory. Threads can share a scene; it survives device loss.

    World axes are x right, y down, z forward.

    Attributes:
        means: [N, 3] float32 centers, world units.
        scales: [N, 3] float32 linear standard deviations along the Gaussian's axes, world units.
        quats: [N, 4] float32 rotations w, x, y, z, of any length but zero.
        opacities: [N] float32 from 0 to 1.
        sh_coeffs: [N, K, 3] float32 coefficients of spherical harmonics for red, green, blue, as in
            3D Gaussian Splatting; K = (sh_degree + 1) ** 2.
        sh_degree: Degree of spherical harmonics, 0 to 3.
        antialiased: Whether the scene was optimized with opacity compensation for screen-space blur
            (Mip-Splatting), which `render` then applies.
        world: "first_camera" or "input_cameras", as stated by the file; else None.
        dropped_count: Number of Gaussians dropped by `drop_invalid`.
        refinement: Result of the refinement behind the scene; None without one.
        edit_counts: Number of Gaussians after each edit of `edit`; empty without one.
        edit_sources: Index of the Gaussian before `edit` that each one was, of several merged the
            most visible; `features[scene.edit_sources]` are this scene's. None without `edit`.

    The arrays are read-only views of library memory and keep it alive; to_numpy, to_torch and
    to_gsplat return copies.
    """

    def __init__(
        self, handle: Handle, device: Optional[Device] = None, refinement: Optional[RefineResult] = None
    ) -> None:
        self._scene, self._device, self.refinement = handle, device, refinement
        self.edit_counts: list[int] = []
        self.edit_sources: Optional[npt.NDArray[np.int64]] = None
        info, found = structure("scene_info"), structure("gaussians")
        call("zs_scene_get_info", handle, info)
        self.world: Optional[World] = _WORLDS.get(info.world)
        self.dropped_count: int = info.dropped_count
        call("zs_scene_get_gaussians", handle, found)
        count = int(found.count)
        self.sh_degree: int = found.sh_degree
        self.antialiased = bool(found.antialiased)
        self.means: Array = array_at(handle, found.means, (count, 3))
        self.scales: Array = array_at(handle, found.scales, (count, 3))
        self.quats: Array = array_at(handle, found.quats, (count, 4))
        self.opacities: Array = array_at(handle, found.opacities, (count,))
        self.sh_coeffs: Array = array_at(handle, found.sh_coeffs, (count, (self.sh_degree + 1) ** 2, 3))

    @classmethod
    def open(cls, path: PathLike, *, drop_invalid: bool = False) -> Scene:
        """Opens a scene file: PLY, .compressed.ply, SPZ, .sog, .splat, .gltf or .glb.

        glTF uses KHR_gaussian_splatting. Axes become x right, y down, z forward.

        Args:
            path: The file.
            drop_invalid: Drops Gaussians with NaN, infinite or out-of-range values instead of
                rejecting the file.
        """
        options = structure("scene_open_options", drop_invalid=int(drop_invalid))
        return cls(Handle("scene", "zs_scene_open", os.fsencode(path), options))

    @classmethod
    def from_bytes(cls, data: bytes, format: Optional[Format] = None, *, drop_invalid: bool = False) -> Scene:
        """Decodes a scene file in memory, as `open`.

        PLY, SPZ and .glb are recognized by content; `format` is "splat", "sog" or "gltf" otherwise.
        """
        name = _name(format)
        options = structure("scene_open_options", drop_invalid=int(drop_invalid), format=name)
        return cls(Handle("scene", "zs_scene_from_memory", data, len(data), options))

    @classmethod
    def from_arrays(
        cls,
        means: npt.ArrayLike,
        scales: npt.ArrayLike,
        quats: npt.ArrayLike,
        opacities: npt.ArrayLike,
        sh_coeffs: npt.ArrayLike,
        antialiased: bool = False,
    ) -> Scene:
        """Creates a scene from copies of arrays, shaped like the attributes.

        Raises:
            ArgumentError: a shape is invalid, or a value not finite or out of range.
        """
        gaussians, _arrays = native_gaussians(means, scales, quats, opacities, sh_coeffs, antialiased=antialiased)
        return cls(Handle("scene", "zs_scene_create", gaussians))

    @classmethod
    def from_points(
        cls,
        positions: npt.ArrayLike,
        colors: Optional[npt.ArrayLike] = None,
        cameras: Sequence[Camera] = (),
        images: Optional[ImagesLike] = None,
    ) -> Scene:
        """Creates a scene with a Gaussian per point, to be refined.

        Args:
            positions: [N, 3] in world units.
            colors: [N, 3] uint8 red, green, blue; None for gray.
            cameras: Cameras that limit the sizes of the Gaussians.
            images: Photos of the cameras, or a Capture, as for refine: adds Gaussians where stereo
                finds surfaces without points.

        Example:
            >>> scene = Scene.from_points(points, colors, images=capture).refine(capture)
        """
        points = np.require(positions, np.float32, ["C", "A"])
        paint = None
        if colors is not None:
            given = np.asarray(colors)
            paint = np.ascontiguousarray(given, np.uint8)
            if given.dtype.kind not in "iu" or not np.array_equal(given, paint):
                raise ArgumentTypeError(f"colors: found {given.dtype}, expected whole numbers from 0 to 255, as uint8")
        for name, array in (("positions", points), ("colors", points if paint is None else paint)):
            if points.ndim != 2 or array.shape != (len(points), 3):
                raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected [N, 3]")
        pointers = (
            ffi.cast("float *", points.ctypes.data),
            ffi.NULL if paint is None else ffi.cast("uint8_t *", paint.ctypes.data),
        )
        if images is None:
            views = native_cameras(cameras)
            return cls(Handle("scene", "zs_scene_from_points", *pointers, len(points), views, len(views)))
        sources, views = posed(images, cameras or None)
        photos, _kept = native_images(sources)
        cameras_of = native_cameras(views)
        return cls(Handle("scene", "zs_scene_from_photos", photos, cameras_of, len(views), *pointers, len(points)))

    @classmethod
    def from_gsplat(cls, params: Mapping[str, Any], antialiased: bool = False) -> Scene:
        """Creates a scene from copies of gsplat's parameters, arrays or tensors.

        Args:
            params: "means" [N, 3], "scales" [N, 3] logarithms, "quats" [N, 4], "opacities" [N]
                logits, "sh0" [N, 1, 3] and "shN" [N, K - 1, 3]. Its checkpoints have them as
                "splats".
            antialiased: Whether they were optimized with rasterize_mode "antialiased".

        Example:
            >>> scene = Scene.from_gsplat(torch.load("ckpt.pt")["splats"])
        """
        names = ("means", "scales", "quats", "opacities", "sh0", "shN")
        missing = [name for name in names if name not in params]
        if missing:
            raise ArgumentError(f"params: found none of {', '.join(missing)}, expected {', '.join(names)}")
        means, scales, quats, opacities, *sh = (_host(params[name]) for name in names)
        probabilities = 1 / (1 + np.exp(-opacities.astype(np.float64)))
        coeffs = np.concatenate(sh, axis=1)
        return cls.from_arrays(means, np.exp(scales), quats, probabilities, coeffs, antialiased)

    def to_gsplat(self, device: Union[str, TorchDevice] = "cpu") -> dict[str, torch.Tensor]:
        """Returns copies as gsplat's parameters, tensors on a torch device; see from_gsplat.

        Example:
            >>> params = torch.nn.ParameterDict(scene.to_gsplat("cuda"))
        """
        found = self.to_torch(device)
        coeffs = found.pop("sh_coeffs")
        return {
            **found,
            "scales": found["scales"].clamp_min(_LEAST_SCALE).log(),
            "opacities": found["opacities"].logit(_LEAST_OPACITY),
            "sh0": coeffs[:, :1].contiguous(),
            "shN": coeffs[:, 1:].contiguous(),
        }

    def to_torch(self, device: Union[str, TorchDevice] = "cpu") -> dict[str, torch.Tensor]:
        """Returns copies of the arrays by name, float32 tensors on a torch device."""
        import torch

        return {name: torch.from_numpy(array).to(device) for name, array in self.to_numpy().items()}

    def to_numpy(self) -> dict[str, Array]:
        """Returns writable copies of the arrays by name."""
        return {name: np.array(getattr(self, name)) for name in FIELDS}

    def save(self, path: PathLike, *, spz_version: SpzVersion = 3) -> None:
        """Writes a .ply, .spz, .sog, .splat, .gltf or .glb file, by the path's extension.

        An existing file is replaced atomically.

        Args:
            path: The file.
            spz_version: SPZ version: 2, 3 or 4.
        """
        call("zs_scene_save", self._scene, os.fsencode(path), structure("scene_save_options", spz_version=spz_version))

    def to_bytes(self, format: Format, *, spz_version: SpzVersion = 3) -> bytes:
        """Encodes the scene as "ply", "spz", "sog", "splat", "gltf" or "glb"."""
        options = structure("scene_save_options", spz_version=spz_version)
        found = Handle("blob", "zs_scene_to_memory", self._scene, _name(format), options)
        data, size = ffi.new("void **"), ffi.new("size_t *")
        call("zs_blob_get", found, data, size)
        return bytes(ffi.buffer(data[0], size[0]))

    def edit(
        self, edits: Sequence[Edit] = (), *, merge: Sequence[Scene] = (), cameras: Sequence[Camera] = ()
    ) -> Scene:
        """Returns a copy with other scenes appended, and edits applied in order.

        Args:
            edits: Names, or pairs of a name and its numbers, in world units; missing ones are 0:
                "crop_box" (lower x, y, z, upper x, y, z), "crop_sphere" (x, y, z, radius),
                "translate" (x, y, z), "rotate" (degrees about x, then y, then z), "scale",
                "level" (the cameras' mean up becomes -y), "min_opacity", "max_size" (standard
                deviation), "min_neighbors" (number, radius), "min_views" (number of cameras whose
                pictures contain the center), "clean" (drops floaters), "sh_degree", "decimate"
                (merges similar neighbors; number left, or a fraction below 1), "sort" (by opacity
                times the two largest scales).
            merge: Scenes in the same world, antialiased like this one.
            cameras: Cameras in the scene's world, for "level", "min_views" and "clean".

        Raises:
            ArgumentError: an edit is invalid, needs cameras, or leaves no Gaussian; only some scenes
                are antialiased.

        Example:
            >>> small = scene.edit(["clean", ("crop_sphere", (0, 0, 2, 1.5)), ("decimate", 0.5)])
            >>> small.edit_counts
            [9120, 4031, 2016]
        """
        pairs = [(edit, ()) if isinstance(edit, str) else edit for edit in edits]
        given = ffi.new("zs_edit[]", len(pairs))
        for to, (name, numbers) in zip(given, pairs):
            values = [float(number) for number in np.atleast_1d(np.asarray(numbers, np.float64))]
            to.struct_size, to.kind = ffi.sizeof("zs_edit"), choose("edits", name, _EDITS)
            if len(values) > len(to.numbers):
                raise ArgumentError(f"{name}: found {len(values)} numbers, expected at most {len(to.numbers)}")
            to.numbers = values
        scenes = [self, *merge]
        handles = ffi.new("zs_scene *[]", [scene._scene.pointer for scene in scenes])
        counts, views = ffi.new("size_t[]", max(len(pairs), 1)), native_cameras(cameras)
        arrays = (handles, len(scenes), given, len(pairs), views, len(views))
        sources = np.empty(sum(len(scene) for scene in scenes), np.uintp)
        found = ffi.from_buffer("size_t[]", sources)
        edited = Scene(Handle("scene", "zs_scene_edit", *arrays, counts, found), self._device)
        edited.edit_counts = list(counts)[: len(pairs)]
        edited.edit_sources = sources[: len(edited)].astype(np.int64)
        return edited

    def lift(
        self, values: Sequence[npt.ArrayLike], cameras: Sequence[Camera], *, group: int = 1, device: DeviceLike = None
    ) -> tuple[Array, Array]:
        """Lifts pixel values of pictures to features of Gaussians, or of tokens.

        A feature is the mean over all pixels, weighted by the blending weights of its Gaussians.

        Args:
            values: Per camera [h, w, C] float32, in pixels or larger cells; cells with a NaN do
                not count.
            cameras: Cameras in the scene's world.
            group: Consecutive Gaussians per feature: 1, or those of a token.
            device: The device, as for Device; None for the scene's own or the best.

        Returns:
            Features [N / group, C], 0 where no pixel shows any, and weights [N / group] in pixels.

        Example:
            >>> features, weights = scene.lift(patch_features, capture.cameras)
            >>> pictures = scene.render_features(features, capture.cameras[:1])  # [1, height, width, C]
        """
        arrays = [np.require(value, np.float32, ["C", "A"]) for value in values]
        channels = {array.shape[-1] for array in arrays if array.ndim == 3}
        if len(arrays) != len(cameras) or len(channels) != 1 or any(array.ndim != 3 for array in arrays):
            shapes = [array.shape for array in arrays]
            raise ArgumentError(f"values: found shapes {shapes}, expected [h, w, C] for each of {len(cameras)} cameras")
        given = ffi.new("zs_pixel_values[]", len(arrays))
        for to, array in zip(given, arrays):
            to.struct_size, (to.height, to.width) = ffi.sizeof("zs_pixel_values"), array.shape[:2]
            to.values = ffi.cast("float *", array.ctypes.data)
        rows = len(self.opacities) // max(group, 1)
        features, weights = np.zeros((rows, *channels), np.float32), np.zeros(rows, np.float32)
        views = native_cameras(cameras)
        sizes = (len(arrays), features.shape[1], positive("group", group))
        pointers = [ffi.cast("float *", array.ctypes.data) for array in (features, weights)]
        call("zs_lift_features", self._renderer(device), self._scene, views, given, *sizes, *pointers)
        return features, weights

    def render_features(
        self, features: npt.ArrayLike, cameras: Sequence[Camera], *, device: DeviceLike = None
    ) -> Array:
        """Renders features as pictures of as many channels, 0 where nothing is.

        Args:
            features: [N / group, C] float32 of every group of consecutive Gaussians.
            cameras: Cameras of one size, in the scene's world.
            device: The device, as for Device; None for the scene's own or the best.

        Returns:
            [cameras, height, width, C] float32.
        """
        rows = np.require(features, np.float32, ["C", "A"])
        sizes = {(camera.height, camera.width) for camera in cameras}
        if rows.ndim != 2 or len(sizes) != 1:
            found = f"features of shape {rows.shape}, cameras of sizes {sorted(sizes)}"
            raise ArgumentError(f"found {found}, expected [N / group, C] and cameras of one size")
        group = len(self.opacities) // max(len(rows), 1)
        if group * len(rows) != len(self.opacities):
            expected = f"a row for each group of {len(self.opacities)} Gaussians"
            raise ArgumentError(f"features: found {len(rows)} rows, expected {expected}")
        pictures = np.empty((len(cameras), *sizes.pop(), rows.shape[1]), np.float32)
        source, target = (ffi.cast("float *", array.ctypes.data) for array in (rows, pictures))
        views = native_cameras(cameras)
        counts = (rows.shape[1], group, views, len(views))
        call("zs_render_features", self._renderer(device), self._scene, source, *counts, target)
        return pictures

    def _renderer(self, device: DeviceLike) -> Handle:
        opened_device = opened(self._device if device is None else device)
        return Handle("renderer", "zs_renderer_create", opened_device._handle, ffi.NULL)

    def refine(
        self,
        images: ImagesLike,
        cameras: Optional[CamerasLike] = None,
        *,
        steps: Optional[int] = None,
        seconds: float = 60.0,
        views_per_step: int = 4,
        holdout_views: Union[int, Literal["auto"]] = "auto",
        max_image_size: Optional[tuple[int, int]] = (1600, 1600),
        seed: int = 0,
        optimize_cameras: bool = False,
        exposure: ExposureMode = "auto",
        max_gaussians: Union[int, Literal["auto"]] = "auto",
        perceptual_weight: float = 0.0,
        target: RefineTarget = "gaussians",
        antialiased: Optional[bool] = None,
        depths: Optional[DepthsLike] = None,
        depth_kind: DepthKind = "metric",
        depth_weight: Optional[float] = None,
        checkpoint: Optional[PathLike] = None,
        masks: Optional[MasksLike] = None,
        invert_masks: bool = False,
        progress: Optional[ProgressFunction] = None,
        device: DeviceLike = None,
    ) -> Scene:
        """Returns a copy of the scene, optimized to match photos.

        Args:
            images: Photos, as for Model.reconstruct.
            cameras: Their cameras, in the scene's world; None with a Capture.
            steps: Optimizer steps; None for `seconds`.
            seconds: Time to spend, about: the steps and the photos' size follow from the measured
                time of a few steps.
            views_per_step: Photos per step.
            holdout_views: Number of held-out photos; "auto" is one of 40 or more, none with
                `optimize_cameras`.
            max_image_size: Limits of a photo's width and height; larger ones are downscaled. None
                for full size.
            seed: Seed of the photo order.
            optimize_cameras: Whether to optimize the training photos' cameras, except the first.
            exposure: "on" learns a color transform per photo, for photos of different exposure or
                white balance; "auto" does if they explain much of the error after a few steps.
            max_gaussians: Final number of Gaussians; at most the scene's number: no growth. "auto"
                grows from 50 steps on, if the photos' PSNR is below 25 dB.
            perceptual_weight: Weight of the LPIPS (VGG) distance in the loss, whose weights
                tools/lpips.py of a checkout fetches.
            target: "gaussians", or "tokens" of a Reconstruction of a model with `tokens`.
            antialiased: Whether to draw and return an antialiased scene; None for the scene's own.
            depths: Known depth of each image, [height, width] along the camera's z axis and 0 if
                unknown, or None; it joins the loss.
            depth_kind: "metric" depth is in the scene's unit. The inverse of "relative" depth, as of
                a depth network, is fitted to each photo's rendered one by a scale and a shift.
            depth_weight: Initial weight of depth, which falls to a hundredth; None for the kind's.
            checkpoint: File of the state, written each minute and when stopped. The same call
                continues from it.
            masks: Pixels to ignore, as for Model.reconstruct.
            invert_masks: Whether 0 keeps a pixel, and other values ignore it.
            progress: Called with the Progress after each step. Returning False ends the refinement
                with its best scene. Its exceptions propagate.
            device: The device, as for Device; None for the scene's own or the best.

        Returns:
            The refined scene, with its result in `refinement`.

        Example:
            >>> refined = scene.refine(Capture.open("capture/"), steps=200)
            >>> refined.refinement.stop_reason
            'finished'
        """
        if not seconds > 0:
            raise ArgumentError(f"seconds: found {seconds}, expected a time above 0")
        sources, views = posed(images, cameras)
        on = opened(self._device if device is None else device)
        if depth_weight is not None and not depth_weight > 0:
            raise ArgumentError(f"depth_weight: found {depth_weight}, expected a number above 0")
        photos, _kept = native_images(sources, masks, invert_masks, depths)
        callback = Callback(progress)
        state = ffi.NULL if checkpoint is None else ffi.new("char[]", os.fsencode(checkpoint))
        refined_cameras = native_cameras(views)
        options = structure(
            "refine_options",
            steps=0 if steps is None else positive("steps", steps),
            seconds=seconds if steps is None else 0.0,
            views_per_step=positive("views_per_step", views_per_step),
            holdout_views=0 if holdout_views == "auto" else int(holdout_views) or lib.ZS_HOLDOUT_VIEWS_NONE,
            max_image_size=[positive("max_image_size", side) for side in max_image_size or (2**32 - 1,) * 2],
            seed=seed,
            optimize_cameras=int(optimize_cameras),
            exposure=choose("exposure", exposure, _EXPOSURE_MODES),
            max_gaussians=0 if max_gaussians == "auto" else max(max_gaussians, 1),
            perceptual_weight=perceptual_weight,
            target=choose("target", target, _REFINE_TARGETS),
            antialiasing=ANTIALIASING[antialiased],
            depth_loss=lib.ZS_DEPTH_LOSS_OFF if depths is None else choose("depth_kind", depth_kind, _DEPTH_KINDS),
            depth_weight=depth_weight or 0.0,
            checkpoint=state,
            **callback.fields,
        )
        exposures = np.empty((len(sources), 3, 4), np.float32)
        learned = ffi.from_buffer("float[]", exposures)
        result = structure("refine_result", cameras=refined_cameras, exposures=learned)
        function, *owners = self._refined(on, target)
        arguments = (*owners, photos, native_cameras(views), len(sources), options, result)
        return Scene(Handle("scene", function, *arguments), on, refine_result(result, refined_cameras, exposures))

    def _refined(self, device: Device, target: RefineTarget) -> tuple[Any, ...]:
        """Returns the library's function of a refinement and its first arguments."""
        if target == "tokens":
            raise ArgumentError("target: found 'tokens' of a scene without any, expected 'gaussians'")
        return "zs_refine_scene", device._handle, self._scene

    def render(
        self,
        cameras: Union[Camera, Sequence[Camera]],
        *,
        alpha: bool = False,
        depth: Optional[DepthMode] = None,
        normals: bool = False,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        antialiased: Optional[bool] = None,
        dtype: npt.DTypeLike = np.uint8,
    ) -> RenderOutput:
        """Renders the scene once, as Renderer.render; for repeated calls keep a Renderer."""
        from .renderer import Renderer

        with Renderer(self) as renderer:
            return renderer.render(
                cameras,
                alpha=alpha,
                depth=depth,
                normals=normals,
                background=background,
                antialiased=antialiased,
                dtype=dtype,
            )

    def show(self, height: int = 600, *, cameras: Optional[PathLike] = None) -> command.Page:
        """Shows the scene in a notebook, by `zipsplat view`.

        Args:
            height: Height of the frame in pixels.
            cameras: A transforms.json or COLMAP model in the scene's world.

        Raises:
            CommandError: the `zipsplat` command is missing or fails.
        """
        return command.view(self.to_bytes("ply"), height, cameras)

    def __len__(self) -> int:
        return len(self.means)

    def __reduce__(self) -> tuple[Any, ...]:
        return Scene.from_arrays, (*self.to_numpy().values(), self.antialiased)

    def __repr__(self) -> str:
        return f"<zipsplat.Scene of {len(self):,} Gaussians, degree {self.sh_degree}>"

    def _repr_html_(self) -> str:
        rows = [("Gaussians", f"{len(self):,}"), ("spherical harmonics", f"degree {self.sh_degree}")]
        rows += [("antialiased", "yes")] * self.antialiased
        if len(self):
            ends = [self.means.min(axis=0), self.means.max(axis=0)]
            rows += [(axis, f"{low:.3g} to {high:.3g}") for axis, low, high in zip("xyz", *ends)]
        cells = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in rows)
        return f"<table>{cells}</table>"


def native_gaussians(*fields: npt.ArrayLike, antialiased: bool) -> tuple[Any, list[Array]]:
    """Converts arrays in the order of FIELDS for the library, with references to keep alive."""
    arrays = [np.require(field, np.float32, ["C", "A"]) for field in fields]
    count = len(arrays[0]) if arrays[0].ndim else 0
    bands = math.isqrt(arrays[4].shape[1]) if arrays[4].ndim == 3 else 1
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, bands**2, 3)]
    for name, array, shape in zip(FIELDS, arrays, shapes):
        if array.shape != shape:
            raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected {list(shape)}")
    pointers = {name: ffi.cast("float *", array.ctypes.data) for name, array in zip(FIELDS, arrays)}
    return structure("gaussians", count=count, sh_degree=bands - 1, antialiased=antialiased, **pointers), arrays


def _name(format: Optional[str]) -> Any:
    return ffi.NULL if format is None else ffi.new("char[]", format.encode())


def _host(values: Any) -> Array:
    """Returns an array or tensor as a float32 array."""
    return np.asarray(values.detach().cpu() if hasattr(values, "detach") else values, np.float32)
