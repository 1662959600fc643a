"""Pinhole cameras with OpenCV axes, and captures: photos with cameras."""

from __future__ import annotations

import math
import os
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterable, Optional, Sequence, Union, overload

import numpy as np
import numpy.typing as npt

from ._native import Handle, call, ffi, structure, text, warned
from .errors import ArgumentError, ArgumentTypeError

Matrices = npt.ArrayLike
PathLike = Union[str, "os.PathLike[str]"]
_LAST_ROW = np.array([[0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward. Pixel centers are at +0.5.

    Attributes:
        width: Width in pixels.
        height: Height in pixels.
        fx: Horizontal focal length in pixels.
        fy: Vertical focal length in pixels.
        cx: Horizontal principal point in pixels from the left edge.
        cy: Vertical principal point in pixels from the top edge.
        camera_to_world: [4, 4] float64 pose. The rotation's columns are the camera's right, down
            and forward axes; the translation is its center in world units.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        found = np.array(self.camera_to_world, np.float64)
        if found.shape == (3, 4):
            found = np.concatenate([found, _LAST_ROW])
        _check("camera_to_world", found.shape, (4, 4))
        found.flags.writeable = False
        object.__setattr__(self, "camera_to_world", found)

    @classmethod
    def from_matrices(
        cls,
        Ks: Matrices,
        width: int,
        height: int,
        *,
        camera_to_world: Optional[Matrices] = None,
        world_to_camera: Optional[Matrices] = None,
    ) -> Cameras:
        """Creates cameras from matrices with OpenCV axes.

        Args:
            Ks: [C, 3, 3] intrinsics in pixels, or [3, 3] shared by all.
            width: Width in pixels.
            height: Height in pixels.
            camera_to_world: [C, 4, 4] or [C, 3, 4] poses in world units; either these or inverses.
            world_to_camera: Inverse poses, the "viewmats".

        Example:
            >>> cameras = Camera.from_matrices(Ks, 640, 480, world_to_camera=viewmats)
            >>> cameras[:2].viewmats.shape
            (2, 4, 4)
        """
        if (camera_to_world is None) == (world_to_camera is None):
            raise ArgumentError("expected camera_to_world or world_to_camera, one of them")
        name = "camera_to_world" if world_to_camera is None else "world_to_camera"
        poses = np.asarray(camera_to_world if world_to_camera is None else world_to_camera, np.float64)
        if poses.ndim != 3 or poses.shape[1:] not in ((4, 4), (3, 4)):
            raise ArgumentError(f"{name}: found shape {list(poses.shape)}, expected [C, 4, 4]")
        if poses.shape[1] == 3:
            poses = np.concatenate([poses, np.broadcast_to(_LAST_ROW, (len(poses), 1, 4))], axis=1)
        lenses = np.asarray(Ks, np.float64)
        if lenses.shape == (3, 3):
            lenses = np.broadcast_to(lenses, (len(poses), 3, 3))
        _check("Ks", lenses.shape, (len(poses), 3, 3))
        if world_to_camera is not None:
            poses = np.asarray(np.linalg.inv(poses), np.float64)
        return Cameras(
            cls(int(width), int(height), float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), pose)
            for K, pose in zip(lenses, poses)
        )

    @classmethod
    def from_fov(
        cls, width: int, height: int, hfov_deg: float = 60.0, *, camera_to_world: Optional[Matrices] = None
    ) -> Camera:
        """Creates a centered camera from a horizontal field of view, by default at the origin."""
        focal = width / (2 * math.tan(math.radians(hfov_deg) / 2))
        pose = np.eye(4) if camera_to_world is None else np.asarray(camera_to_world, np.float64)
        return cls(width, height, focal, focal, width / 2, height / 2, pose)

    @property
    def world_to_camera(self) -> npt.NDArray[np.float64]:
        """[4, 4] float64 inverse of `camera_to_world`."""
        return np.asarray(np.linalg.inv(self.camera_to_world), np.float64)

    @property
    def K(self) -> npt.NDArray[np.float64]:
        """[3, 3] float64 intrinsics in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    def relative_to(self, other: Camera) -> Camera:
        """Returns this camera relative to another camera's space."""
        pose = other.world_to_camera @ self.camera_to_world
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, pose)


class Cameras(Sequence[Camera]):
    """A sequence of cameras with their matrices. Slices are Cameras."""

    def __init__(self, cameras: Iterable[Camera]) -> None:
        self._cameras = list(cameras)
        for camera in self._cameras:
            if not isinstance(camera, Camera):
                raise ArgumentTypeError(f"found a camera of type {type(camera).__name__}, expected zipsplat.Camera")

    @property
    def Ks(self) -> npt.NDArray[np.float64]:
        """[C, 3, 3] float64 intrinsics in pixels."""
        return np.array([camera.K for camera in self._cameras], np.float64).reshape(-1, 3, 3)

    @property
    def camera_to_world(self) -> npt.NDArray[np.float64]:
        """[C, 4, 4] float64 poses."""
        return np.array([camera.camera_to_world for camera in self._cameras], np.float64).reshape(-1, 4, 4)

    @property
    def viewmats(self) -> npt.NDArray[np.float64]:
        """[C, 4, 4] float64 inverse poses: world to camera."""
        return np.asarray(np.linalg.inv(self.camera_to_world), np.float64)

    def __len__(self) -> int:
        return len(self._cameras)

    @overload
    def __getitem__(self, index: int) -> Camera: ...
    @overload
    def __getitem__(self, index: slice) -> Cameras: ...
    def __getitem__(self, index: Union[int, slice]) -> Union[Camera, Cameras]:
        return Cameras(self._cameras[index]) if isinstance(index, slice) else self._cameras[index]

    def __repr__(self) -> str:
        return f"<zipsplat.Cameras, {len(self)} of them>"


@dataclass(frozen=True, eq=False)
class CaptureView:
    """A photo of a capture.

    Attributes:
        name: Name as written in the file.
        path: Path of the photo; None if not found near the file.
        camera: Undistorted pinhole camera, in the file's world and scale.
        index: Number of the photo in the file, from 0.
    """

    name: str
    path: Optional[Path]
    camera: Camera
    index: int


class Capture(Sequence[CaptureView]):
    """Posed photos of a transforms.json (instant-ngp, nerfstudio) or COLMAP model.

    A sequence of views, accepted by Model.reconstruct and Scene.refine. Slices are captures. Photos
    are read undistorted, ignoring the EXIF orientation. Photos of lenses wider than 110 degrees
    have several views, one after another and of one name.

    Attributes:
        warnings: Descriptions of ignored data.
    """

    def __init__(self, handle: Handle) -> None:
        self._handle = handle
        info = structure("capture_info")
        call("zs_capture_get_info", self._handle, info)
        self.warnings: list[str] = warned(text(info.warnings).splitlines())
        self._views = [self._view(index) for index in range(info.view_count)]
        self._count: int = info.view_count
        # Keeps a temporary folder alive.
        self._keeps: object = None

    @classmethod
    def open(cls, path: PathLike) -> Capture:
        """Opens a transforms.json, a COLMAP model folder, or a folder that contains either.

        Raises:
            FileError, FormatError, ArgumentError: it is unreadable, malformed or missing.

        Example:
            >>> capture = Capture.open("capture/")
            >>> scene = model.reconstruct(capture[:8])
        """
        return cls(Handle("capture", "zs_capture_open", os.fsencode(path)))

    @classmethod
    def from_cameras(cls, cameras: Iterable[Camera], names: Sequence[str], paths: Sequence[PathLike] = ()) -> Capture:
        """Creates a capture of undistorted photos.

        Args:
            cameras: Cameras of the photos.
            names: Names of the photos, as in a file.
            paths: Paths of the photos, if known.

        Example:
            >>> Capture.from_cameras(cameras, ["1.jpg", "2.jpg"]).save("transforms.json")
        """
        structures = native(cameras)
        if len(names) != len(structures) or len(paths) not in (0, len(structures)):
            found = f"{len(names)} names and {len(paths)} paths"
            raise ArgumentError(f"found {found}, expected one for each of {len(structures)} cameras")
        views, strings = ffi.new("zs_capture_view[]", len(names)), []
        for index, view in enumerate(views):
            strings.append(ffi.new("char[]", names[index].encode()))
            strings.append(ffi.new("char[]", os.fsencode(paths[index])) if paths else ffi.NULL)
            view.struct_size = ffi.sizeof("zs_capture_view")
            view.name, view.path, view.camera = *strings[-2:], ffi.addressof(structures, index)
        return cls(Handle("capture", "zs_capture_create", views, len(views)))

    def save(self, path: PathLike) -> None:
        """Writes cameras and photo paths of a whole capture as a transforms.json (nerfstudio).

        An existing file is replaced atomically.
        """
        if [view.index for view in self._views] != list(range(self._count)):
            raise ArgumentError(f"found {len(self)} of {self._count} photos, expected a whole capture")
        call("zs_capture_save", self._handle, os.fsencode(path))

    @property
    def cameras(self) -> Cameras:
        """Cameras of all views."""
        return Cameras(view.camera for view in self._views)

    def find(self, path: PathLike) -> Optional[int]:
        """Returns the index of a photo by file name, then by the longest common path suffix.

        None without a match.

        Raises:
            ArgumentError: the match is ambiguous.
        """
        found = ffi.new("size_t *")
        call("zs_capture_find", self._handle, os.fsencode(path), found)
        return next((at for at, view in enumerate(self._views) if view.index == found[0]), None)

    def __len__(self) -> int:
        return len(self._views)

    @overload
    def __getitem__(self, index: int) -> CaptureView: ...
    @overload
    def __getitem__(self, index: slice) -> Capture: ...
    def __getitem__(self, index: Union[int, slice]) -> Union[CaptureView, Capture]:
        if not isinstance(index, slice):
            return self._views[index]
        part = copy(self)
        part._views = self._views[index]
        return part

    def __repr__(self) -> str:
        return f"<zipsplat.Capture of {len(self)} photos>"

    def _view(self, index: int) -> CaptureView:
        view = structure("capture_view")
        call("zs_capture_get_view", self._handle, index, view)
        where = Path(os.fsdecode(ffi.string(view.path))) if view.path else None
        return CaptureView(text(view.name), where, from_native(view.camera), index)


def from_native(found: Any) -> Camera:
    """Converts a camera of the library."""
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(list(found.rotation), (3, 3))
    pose[:3, 3] = list(found.translation)
    return Camera(found.width, found.height, found.fx, found.fy, found.cx, found.cy, pose)


def native(cameras: Iterable[Camera]) -> Any:
    """Converts cameras for the library."""
    given = cameras if isinstance(cameras, Cameras) else Cameras(cameras)
    out = ffi.new("zs_camera[]", len(given))
    for to, camera in zip(out, given):
        to.struct_size = ffi.sizeof("zs_camera")
        to.width, to.height = camera.width, camera.height
        to.fx, to.fy, to.cx, to.cy = camera.fx, camera.fy, camera.cx, camera.cy
        to.rotation = camera.camera_to_world[:3, :3].ravel().tolist()
        to.translation = camera.camera_to_world[:3, 3].tolist()
    return out


def _check(name: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise ArgumentError(f"{name}: found shape {list(found)}, expected {list(expected)}")
