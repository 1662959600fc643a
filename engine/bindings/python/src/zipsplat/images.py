"""Images from files, bytes and arrays, and to files."""

from __future__ import annotations

import os
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Iterable, Optional, Protocol, Sequence, Union

import numpy as np
import numpy.typing as npt

from ._native import Handle, array_at, call, ffi, lib, structure
from .cameras import Camera, Cameras, Capture, PathLike
from .errors import ArgumentError, ArgumentTypeError, FileError

# Recognized photo extensions.
EXTENSIONS = frozenset({".png", ".jpg", ".jpeg", ".webp"})


class HasArrayInterface(Protocol):
    """An array or PIL image."""

    @property
    def __array_interface__(self) -> dict[str, Any]: ...


class HasDLPack(Protocol):
    """A tensor of any library."""

    def __dlpack__(self, *args: Any, **kwargs: Any) -> Any: ...


ImageLike = Union[PathLike, bytes, HasArrayInterface, HasDLPack]
ImagesLike = Union[PathLike, Capture, Sequence[ImageLike]]
MasksLike = Union[PathLike, Sequence[npt.ArrayLike]]
DepthsLike = Sequence[Optional[npt.ArrayLike]]
CamerasLike = Union[PathLike, Capture, Sequence[Camera]]


def list_images(folder: PathLike) -> list[Path]:
    """Lists the visible photos (PNG, JPEG, WebP) of a folder in natural order.

    Raises:
        ArgumentError: there are none.
        FileError: the folder cannot be read.

    Example:
        >>> list_images("photos/")[:2]
        [PosixPath('photos/1.jpg'), PosixPath('photos/2.jpg')]
    """
    try:
        files = [path for path in Path(folder).iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise FileError(f"{folder}: {error.strerror}") from error
    found = [path for path in files if path.is_file() and path.suffix.lower() in EXTENSIONS]
    if not found:
        raise ArgumentError(f"photos in {folder}: found none, expected files in {', '.join(sorted(EXTENSIONS))}")
    return sorted(found, key=lambda path: (_natural(path.name), str(path)))


def load_image(path: PathLike) -> npt.NDArray[np.uint8]:
    """Reads a photo as [height, width, 3] uint8 with its EXIF orientation applied.

    Raises:
        FileError, FormatError: it is unreadable, or not a PNG, JPEG or WebP.

    Example:
        >>> tensor = torch.from_numpy(load_image("photo.jpg"))
    """
    return _array(Handle("image_buffer", "zs_image_buffer_open", os.fsencode(path)))


def save_image(path: PathLike, pixels: npt.ArrayLike) -> None:
    """Writes [height, width, 3 or 4] pixels as a PNG without alpha.

    Values are uint8 from 0 to 255 or float from 0 to 1. An existing file is replaced atomically.

    Example:
        >>> save_image("view.png", scene.render(camera).rgb)
    """
    images, _kept = native([pixels])
    call("zs_image_save_png", images, os.fsencode(path))


def native(
    sources: Sequence[Any],
    masks: Optional[MasksLike] = None,
    inverted: bool = False,
    depths: Optional[DepthsLike] = None,
) -> tuple[Any, list[Any]]:
    """Converts images for the library, with references to keep alive. Decodes in parallel."""
    of_files, arrays, known = None, None, []
    if isinstance(masks, (str, os.PathLike)):
        folder = ffi.NULL if masks == "alpha" else ffi.new("char[]", os.fsencode(masks))
        of_files = structure("masks", inverted=int(inverted), folder=folder)
    elif masks is not None:
        arrays = [_mask(f"mask {index}", mask, inverted) for index, mask in enumerate(masks)]
        if len(arrays) != len(sources):
            raise ArgumentError(f"found {len(arrays)} masks, expected one for each of {len(sources)} images")
    if depths is not None:
        known = [None if depth is None else np.require(depth, np.float32, ["C", "A"]) for depth in depths]
        if len(known) != len(sources):
            raise ArgumentError(f"found {len(known)} depths, expected one for each of {len(sources)} images")
    with ThreadPoolExecutor(max_workers=os.cpu_count() or 1) as pool:
        loaded = list(pool.map(lambda index, source: _load(index, source, of_files), range(len(sources)), sources))
    out = ffi.new("zs_image[]", len(loaded))
    for index, (to, source) in enumerate(zip(out, loaded)):
        to.struct_size = ffi.sizeof("zs_image")
        if isinstance(source, Handle):
            call("zs_image_buffer_get_image", source, ffi.addressof(to))
        else:
            to.format = _FORMATS[source.dtype.type, source.shape[2]]
            to.height, to.width = source.shape[:2]
            to.stride = source.strides[0]
            to.pixels = ffi.cast("void *", source.ctypes.data)
        if arrays is not None:
            if arrays[index].shape != (to.height, to.width):
                found, expected = list(arrays[index].shape), [to.height, to.width]
                raise ArgumentError(f"mask {index}: found shape {found}, expected {expected}, as its image")
            to.mask, to.mask_stride = ffi.cast("uint8_t *", arrays[index].ctypes.data), 0
    for index, (to, depth) in enumerate(zip(out, known)):
        if depth is not None:
            if depth.shape != (to.height, to.width):
                found, expected = list(depth.shape), [to.height, to.width]
                raise ArgumentError(f"depth {index}: found shape {found}, expected {expected}, as its image")
            to.depth = ffi.cast("float *", depth.ctypes.data)
    return out, [loaded, arrays, known]


def _mask(name: str, mask: npt.ArrayLike, inverted: bool) -> npt.NDArray[np.uint8]:
    array = np.asarray(mask)
    if array.ndim != 2:
        raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected [height, width]")
    return np.ascontiguousarray((array != 0) != inverted, dtype=np.uint8)


def matched(
    images: ImagesLike, cameras: Optional[CamerasLike]
) -> tuple[list[Any], Optional[Cameras], Optional[Capture]]:
    """Matches images with cameras; returns images, cameras if any, and their capture.

    Photos without a camera in a capture are dropped: structure from motion rarely places all.
    """
    capture = images if isinstance(images, Capture) else None
    if capture is not None and cameras is not None:
        raise ArgumentError("a Capture has cameras of its own: expected no others")
    if isinstance(cameras, (str, os.PathLike)):
        cameras = Capture.open(cameras)
    if capture is not None:
        sources: list[Any] = [_Posed(capture, view.index, view.path) for view in capture]
        return sources, capture.cameras, capture
    sources = listed(images)
    if not isinstance(cameras, Capture):
        if cameras is not None and len(cameras) != len(sources):
            raise ArgumentError(f"found {len(cameras)} cameras, expected one for each of {len(sources)} images")
        return sources, None if cameras is None else Cameras(cameras), None
    found, views = [], []
    for source in sources:
        if not isinstance(source, (str, os.PathLike)):
            raise ArgumentTypeError(
                f"found an image of type {type(source).__name__}, expected paths: a Capture knows photos by their names"
            )
        first = cameras.find(source)
        if first is None:
            continue
        # Wide photos have several views.
        for view in cameras[first:]:
            if view.name != cameras[first].name:
                break
            found.append(_Posed(cameras, view.index, source))
            views.append(view.camera)
    if not found:
        raise ArgumentError(f"none of {len(sources)} photos is among the {len(cameras)} of the capture")
    return list(found), Cameras(views), cameras


def posed(images: ImagesLike, cameras: Optional[CamerasLike]) -> tuple[list[Any], Cameras]:
    """Matches images with cameras, which are required."""
    sources, views, _ = matched(images, cameras)
    if views is None:
        raise ArgumentError("cameras: found none, expected one per image, as from zipsplat.estimate_cameras")
    return sources, views


def listed(images: Any) -> list[Any]:
    """Expands folders to their images."""
    if isinstance(images, (str, os.PathLike)):
        images = [images]
    elif isinstance(images, bytes) or hasattr(images, "__array_interface__") and getattr(images, "ndim", 3) == 3:
        raise ArgumentTypeError("found one image, expected a sequence of them, such as [image]")
    found: list[Any] = []
    for image in images:
        folder = isinstance(image, (str, os.PathLike)) and os.path.isdir(image)
        found.extend(list_images(image) if folder else [image])
    return found


class _Posed:
    """An undistorted photo of a capture."""

    def __init__(self, capture: Capture, index: int, path: Optional[PathLike]) -> None:
        self.capture, self.index, self.path = capture, index, path

    def open(self, masks: Any) -> Handle:
        path = ffi.NULL if self.path is None else os.fsencode(self.path)
        photo = (self.capture._handle, self.index, path)
        if masks is None:
            return Handle("image_buffer", "zs_capture_open_image", *photo)
        return Handle("image_buffer", "zs_capture_open_masked_image", *photo, masks)


_FORMATS = {
    (np.uint8, 3): lib.ZS_PIXEL_RGB8,
    (np.uint8, 4): lib.ZS_PIXEL_RGBA8,
    (np.float32, 3): lib.ZS_PIXEL_RGB_F32,
    (np.float32, 4): lib.ZS_PIXEL_RGBA_F32,
}


def _load(index: int, source: Any, masks: Any = None) -> Any:
    if isinstance(source, Handle):
        return source
    if isinstance(source, _Posed):
        return source.open(masks)
    if isinstance(source, (str, os.PathLike)) and masks is not None:
        return Handle("image_buffer", "zs_image_buffer_open_masked", os.fsencode(source), masks)
    if masks is not None:
        raise ArgumentTypeError(f"found image {index} of type {type(source).__name__}, expected paths, as masks are")
    if isinstance(source, (str, os.PathLike)):
        return Handle("image_buffer", "zs_image_buffer_open", os.fsencode(source))
    if isinstance(source, (bytes, bytearray, memoryview)):
        data = bytes(source)
        return Handle("image_buffer", "zs_image_buffer_from_memory", data, len(data))
    return _pixels(f"image {index}", source)


def _pixels(name: str, source: Any) -> npt.NDArray[Any]:
    """Returns a contiguous [height, width, 3 or 4] array of uint8 or float32."""
    if hasattr(source, "detach"):
        source = source.detach().cpu()
    elif hasattr(source, "getbands"):
        source = source if source.mode in ("RGB", "RGBA") else source.convert("RGB")
    array = np.asarray(source) if not _only_dlpack(source) else np.from_dlpack(source)
    if array.ndim != 3 or array.shape[2] not in (3, 4) or 0 in array.shape:
        hint = (
            "; torch's [channels, height, width] needs .permute(1, 2, 0)"
            if array.ndim == 3 and array.shape[0] in (3, 4)
            else ""
        )
        raise ArgumentError(f"{name}: found shape {list(array.shape)}, expected [height, width, 3 or 4]{hint}")
    if array.dtype == np.float64 or array.dtype == np.float16:
        array = array.astype(np.float32)
    if array.dtype not in (np.uint8, np.float32):
        raise ArgumentTypeError(f"{name}: found {array.dtype}, expected uint8 from 0 to 255 or float32 from 0 to 1")
    row, pixel, channel = array.strides
    width = array.shape[2] * array.itemsize
    # Rows may be apart or bottom-up, but not shared, as of np.broadcast_to.
    if channel != array.itemsize or pixel != width or abs(row) < array.shape[1] * width:
        array = np.ascontiguousarray(array)
    return array


def _only_dlpack(source: Any) -> bool:
    return hasattr(source, "__dlpack__") and not hasattr(source, "__array__")


def _array(photo: Handle) -> npt.NDArray[np.uint8]:
    image = structure("image")
    call("zs_image_buffer_get_image", photo, image)
    return array_at(photo, image.pixels, (image.height, image.width, 3), "|u1", writable=True)


def _natural(name: str) -> list[tuple[Any, ...]]:
    """Sort key by numeric value: 2.png before 10.png."""

    def key(part: str) -> tuple[Any, ...]:
        digits = part.lstrip("0")
        return ("0", len(digits), digits) if "0" <= part[0] <= "9" else (part,)

    return [key(part) for part in re.findall("[0-9]+|.", name, re.DOTALL)]


def paths_of(images: ImagesLike) -> Iterable[str]:
    """Returns the paths of images, for the command.

    Raises:
        ArgumentTypeError: an image is not a file.
    """
    for image in [images] if isinstance(images, (str, os.PathLike)) else images:
        if not isinstance(image, (str, os.PathLike)):
            raise ArgumentTypeError(f"found an image of type {type(image).__name__}, expected paths")
        yield os.fspath(image)
