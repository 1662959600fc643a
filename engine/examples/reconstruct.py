"""reconstruct.c with ctypes and NumPy, without a build.

usage: ZIPSPLAT_LIBRARY=/prefix/lib/libzipsplat.so python3 reconstruct.py MODEL scene.ply
           image.png PHOTO...
MODEL: builtin, a checkpoint, or seeded:vits

Images are arrays [height, width, channels] of uint8 or float32, Gaussians arrays of float32.
"""

import ctypes
import ctypes.util
import os
import sys

import numpy as np

u32, u64, i32, i64, f64, size, pointer = (
    ctypes.c_uint32, ctypes.c_uint64, ctypes.c_int32, ctypes.c_int64, ctypes.c_double, ctypes.c_size_t, ctypes.c_void_p)


def fields(**named):
    return [("struct_size", u32), *named.items()]


class Sized(ctypes.Structure):
    """A structure with its size set."""

    def __init__(self, **values):
        super().__init__(struct_size=ctypes.sizeof(self), **values)


class Image(Sized):
    _fields_ = fields(format=i32, width=u32, height=u32, stride=i64, pixels=pointer, mask=pointer, mask_stride=i64,
                      depth=pointer)


class Camera(Sized):
    _fields_ = fields(reserved=u32, width=u32, height=u32, fx=f64, fy=f64, cx=f64, cy=f64, rotation=9 * f64,
                      translation=3 * f64)


class RenderBuffers(Sized):
    _fields_ = fields(reserved=u32, stride=i64, pixels=pointer, alpha=pointer, depth=pointer, normals=pointer)


class Gaussians(Sized):
    _fields_ = fields(sh_degree=u32, count=size, means=pointer, scales=pointer, quats=pointer, opacities=pointer,
                      sh_coeffs=pointer, antialiased=u32, reserved=u32)


class ReconstructOptions(Sized):
    _fields_ = fields(world=i32, ratio=f64, scene_scale=f64, token_selection=i32, keep_features=u32, input_size=2 * u32,
                      seed=u64, camera_count=size, cameras=pointer, progress=pointer, user_data=pointer,
                      capture=pointer, kv_pool=pointer, block_size=u32, block_overlap=u32)


RGBA8, RGB8, RGB_F32 = 0, 1, 3
ABI_VERSION = 2

library = ctypes.CDLL(os.environ.get("ZIPSPLAT_LIBRARY") or ctypes.util.find_library("zipsplat") or "libzipsplat.so")
library.zs_status_name.restype = library.zs_last_error.restype = ctypes.c_char_p
if library.zs_abi_version() != ABI_VERSION:
    sys.exit(f"this is for ABI {ABI_VERSION}, the library has {library.zs_abi_version()}")


def call(name, *arguments):
    status = getattr(library, name)(*arguments)
    if status:
        raise RuntimeError(f"{library.zs_status_name(status).decode()}: {library.zs_last_error().decode()}")


class Object:
    """An owned object of the library."""

    def __init__(self, kind, make, *arguments):
        self.kind, self.handle = kind, pointer()
        call(make, *arguments, ctypes.byref(self.handle))

    def __del__(self):
        getattr(library, f"zs_{self.kind}_destroy")(self.handle)


def copied(address, kind, *shape):
    """Copies library memory to an array."""
    return np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(kind)), shape).copy()


def load_image(path):
    """Reads a photo as an array [height, width, 3] of uint8."""
    opened, image = Object("image_buffer", "zs_image_buffer_open", os.fsencode(path)), Image()
    call("zs_image_buffer_get_image", opened.handle, ctypes.byref(image))
    return copied(image.pixels, ctypes.c_uint8, image.height, image.width, 3)


def reconstruct(model, arrays, ratio=1.0):
    """Returns the scene of photos."""
    arrays = [np.ascontiguousarray(a, np.uint8 if a.dtype == np.uint8 else np.float32) for a in arrays]
    images = (Image * len(arrays))(*(
        Image(format=RGB8 if a.dtype == np.uint8 else RGB_F32, width=a.shape[1], height=a.shape[0], pixels=a.ctypes.data)
        for a in arrays))
    options = ReconstructOptions(ratio=ratio)
    count = size(len(arrays))
    made = Object("reconstruction", "zs_reconstruct", model.handle, images, count, ctypes.byref(options))
    return Object("scene", "zs_reconstruction_to_scene", made.handle)


def render(device, scene, side):
    """Renders RGBA [side, side, 4] uint8 from the origin, with a field of view of 60 degrees."""
    focal, identity = 0.866 * side, (9 * f64)(1, 0, 0, 0, 1, 0, 0, 0, 1)
    camera = Camera(width=side, height=side, fx=focal, fy=focal, cx=side / 2, cy=side / 2, rotation=identity)
    pixels = np.empty((side, side, 4), np.uint8)
    buffers = RenderBuffers(pixels=pixels.ctypes.data)
    renderer = Object("renderer", "zs_renderer_create", device.handle, scene.handle)
    call("zs_render", renderer.handle, ctypes.byref(camera), ctypes.byref(buffers), size(1), None)
    return pixels


def save_image(pixels, path):
    """Writes a rendered image as PNG."""
    height, width, _ = pixels.shape
    image = Image(format=RGBA8, width=width, height=height, pixels=pixels.ctypes.data)
    call("zs_image_save_png", ctypes.byref(image), os.fsencode(path))


def gaussians(scene):
    """Returns a scene as a dictionary of arrays."""
    found = Gaussians()
    call("zs_scene_get_gaussians", scene.handle, ctypes.byref(found))
    n, k = found.count, (found.sh_degree + 1) ** 2
    shapes = dict(means=(n, 3), scales=(n, 3), quats=(n, 4), opacities=(n,), sh_coeffs=(n, k, 3))
    return {name: copied(getattr(found, name), ctypes.c_float, *shape) for name, shape in shapes.items()}


if __name__ == "__main__":
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    model_path, scene_path, image_path, *photo_paths = sys.argv[1:]
    device = Object("device", "zs_device_create", None)
    model = Object("model", "zs_model_load", device.handle, os.fsencode(model_path), None)
    scene = reconstruct(model, [load_image(path) for path in photo_paths])
    call("zs_scene_save", scene.handle, os.fsencode(scene_path), None)
    save_image(render(device, scene, 256), image_path)
    for name, array in gaussians(scene).items():
        print(f"{name:10} {str(array.shape):14} from {array.min():.3f} to {array.max():.3f}")
