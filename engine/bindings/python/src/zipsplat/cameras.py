"""Pinhole cameras with OpenCV axes, and captures: photos with cameras."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator, Optional, Sequence, Union

import numpy as np
import numpy.typing as npt

from ._native import Handle, call, ffi, structure, text

Matrix = npt.ArrayLike
PathLike = Union[str, "os.PathLike[str]"]


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
            found = np.concatenate([found, [[0.0, 0.0, 0.0, 1.0]]])
        _check("camera_to_world", found.shape, (4, 4))
        found.flags.writeable = False
        object.__setattr__(self, "camera_to_world", found)

    @classmethod
    def from_matrix(
        cls,
        K: Matrix,
        width: int,
        height: int,
        *,
        camera_to_world: Optional[Matrix] = None,
        world_to_camera: Optional[Matrix] = None,
    ) -> Camera:
        """Creates a camera from matrices with OpenCV axes.

        Args:
            K: [3, 3] intrinsics in pixels.
            width: Width in pixels.
            height: Height in pixels.
            camera_to_world: [4, 4] or [3, 4] pose in world units; either this or its inverse.
            world_to_camera: Inverse pose, the "viewmat".
        """
        [camera] = cameras(
            [K], width, height, camera_to_world=_one(camera_to_world), world_to_camera=_one(world_to_camera)
        )
        return camera

    @classmethod
    def from_fov(
        cls, width: int, height: int, degrees: float = 60.0, *, camera_to_world: Optional[Matrix] = None
    ) -> Camera:
        """Creates a centered camera from a horizontal field of view, by default at the origin."""
        focal = width / (2 * math.tan(math.radians(degrees) / 2))
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


def cameras(
    Ks: Union[Sequence[Matrix], npt.NDArray[Any]],
    width: int,
    height: int,
    *,
    camera_to_world: Optional[Union[Sequence[Matrix], npt.NDArray[Any]]] = None,
    world_to_camera: Optional[Union[Sequence[Matrix], npt.NDArray[Any]]] = None,
) -> list[Camera]:
    """Creates cameras from matrices with OpenCV axes.

    Args:
        Ks: [C, 3, 3] intrinsics in pixels, or shared [3, 3].
        width: Width in pixels.
        height: Height in pixels.
        camera_to_world: [C, 4, 4] or [C, 3, 4] poses in world units; either these or inverses.
        world_to_camera: Inverse poses, the "viewmats".
    """
    if (camera_to_world is None) == (world_to_camera is None):
        raise ValueError("expected camera_to_world or world_to_camera, one of them")
    name = "camera_to_world" if world_to_camera is None else "world_to_camera"
    poses = np.asarray(camera_to_world if world_to_camera is None else world_to_camera, np.float64)
    if poses.ndim != 3 or poses.shape[1:] not in ((4, 4), (3, 4)):
        raise ValueError(f"{name}: found shape {list(poses.shape)}, expected [C, 4, 4]")
    if poses.shape[1] == 3:
        last = np.broadcast_to([[0.0, 0.0, 0.0, 1.0]], (len(poses), 1, 4))
        poses = np.concatenate([poses, last], axis=1)
    lenses = np.asarray(Ks, np.float64)
    if lenses.shape == (3, 3):
        lenses = np.broadcast_to(lenses, (len(poses), 3, 3))
    _check("Ks", lenses.shape, (len(poses), 3, 3))
    if world_to_camera is not None:
        poses = np.asarray(np.linalg.inv(poses), np.float64)
    return [
        Camera(int(width), int(height), float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), pose)
        for K, pose in zip(lenses, poses)
    ]


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo of a capture.

    Attributes:
        name: Name as written in the file.
        path: Path of the photo; None if not found near the file.
        camera: Undistorted pinhole camera, in the file's world and scale.
    """

    name: str
    path: Optional[Path]
    camera: Camera


class Capture(Sequence[Photo]):
    """Posed photos of a transforms.json (instant-ngp, nerfstudio) or COLMAP model.

    A sequence of photos, accepted by Model.reconstruct and Scene.refine. Photos are read
    undistorted, ignoring the EXIF orientation.

    Attributes:
        notes: Descriptions of ignored data.
    """

    def __init__(self, path: PathLike) -> None:
        self._handle = Handle("capture", "zs_capture_open", os.fsencode(path))
        count, notes = ffi.new("size_t *"), ffi.new("char **")
        call("zs_capture_get_count", self._handle.pointer, count, notes)
        self.notes: list[str] = text(notes[0]).splitlines()
        self._photos = [self._photo(index) for index in range(count[0])]
        # Keeps a temporary folder alive.
        self._keeps: object = None

    @classmethod
    def open(cls, path: PathLike) -> Capture:
        """Opens a transforms.json, a COLMAP model folder, or a folder that contains either.

        Raises:
            IoError, FormatError, ArgumentError: it is unreadable, malformed or missing.
        """
        return cls(path)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all photos."""
        return [photo.camera for photo in self._photos]

    def find(self, path: PathLike) -> Optional[int]:
        """Returns the index of a photo by file name, then by the longest common path suffix.

        None without a match.

        Raises:
            ArgumentError: the match is ambiguous.
        """
        index = ffi.new("size_t *")
        call("zs_capture_find", self._handle.pointer, os.fsencode(path), index)
        return int(index[0]) if index[0] < len(self) else None

    def __len__(self) -> int:
        return len(self._photos)

    def __getitem__(self, index: Any) -> Any:
        return self._photos[index]

    def __iter__(self) -> Iterator[Photo]:
        return iter(self._photos)

    def __repr__(self) -> str:
        return f"<zipsplat.Capture of {len(self)} photos>"

    def _photo(self, index: int) -> Photo:
        found, name, path = structure("camera"), ffi.new("char **"), ffi.new("char **")
        call("zs_capture_get", self._handle.pointer, index, found, name, path)
        where = Path(os.fsdecode(ffi.string(path[0]))) if path[0] else None
        return Photo(text(name[0]), where, from_native(found))


def from_native(found: Any) -> Camera:
    """Converts a camera of the library."""
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(list(found.rotation), (3, 3))
    pose[:3, 3] = list(found.translation)
    return Camera(found.width, found.height, found.fx, found.fy, found.cx, found.cy, pose)


def native(cameras: Sequence[Camera]) -> Any:
    """Converts cameras for the library."""
    out = ffi.new("zs_camera[]", len(cameras))
    for to, camera in zip(out, cameras):
        if not isinstance(camera, Camera):
            raise TypeError(f"found a camera of type {type(camera).__name__}, expected zipsplat.Camera")
        to.struct_size = ffi.sizeof("zs_camera")
        to.width, to.height = camera.width, camera.height
        to.fx, to.fy, to.cx, to.cy = camera.fx, camera.fy, camera.cx, camera.cy
        to.rotation = camera.camera_to_world[:3, :3].ravel().tolist()
        to.translation = camera.camera_to_world[:3, 3].tolist()
    return out


def _one(matrix: Optional[Matrix]) -> Optional[npt.NDArray[Any]]:
    return None if matrix is None else np.asarray(matrix, np.float64)[None]


def _check(name: str, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise ValueError(f"{name}: found shape {list(found)}, expected {list(expected)}")
