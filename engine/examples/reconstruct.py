"""Photos to a scene, with ctypes and NumPy and nothing to build.

usage: ZIPSPLAT_LIBRARY=/prefix/lib/libzipsplat.so python3 reconstruct.py MODEL scene.ply PHOTO...

Pictures go in as arrays [height, width, 3] of uint8 or float32, Gaussians come out as arrays of float32.
"""

import ctypes
import ctypes.util
import os
import sys

import numpy as np

u32, u64, i32, i64, f64, pointer = (
    ctypes.c_uint32, ctypes.c_uint64, ctypes.c_int32, ctypes.c_int64, ctypes.c_double, ctypes.c_void_p)


def fields(**named):
    return list(named.items())


class Image(ctypes.Structure):
    _fields_ = fields(pixels=pointer, stride=i64, width=u32, height=u32, format=i32, reserved=u32)


class SceneInfo(ctypes.Structure):
    _fields_ = fields(struct_size=u32, sh_degree=u32, count=u64)


class Gaussians(ctypes.Structure):
    _fields_ = fields(struct_size=u32, sh_degree=u32, count=u64, means=pointer, scales=pointer, quats=pointer,
                      opacities=pointer, sh_coeffs=pointer)


class ReconstructOptions(ctypes.Structure):
    _fields_ = fields(struct_size=u32, reserved=u32, ratio=f64, selection=i32, width=u32, height=u32, camera_count=u32,
                      seed=u64, cameras=pointer, progress=pointer, user_data=pointer)


RGB8, RGB_F32 = 1, 4
ABI_VERSION = 1

library = ctypes.CDLL(os.environ.get("ZIPSPLAT_LIBRARY") or ctypes.util.find_library("zipsplat") or "libzipsplat.so")
library.zs_status_name.restype = library.zs_last_error.restype = ctypes.c_char_p
if library.zs_abi_version() != ABI_VERSION:
    sys.exit(f"this is for ABI {ABI_VERSION}, the library has {library.zs_abi_version()}")


def call(name, *arguments):
    status = getattr(library, name)(*arguments)
    if status:
        raise RuntimeError(f"{library.zs_status_name(status).decode()}: {library.zs_last_error().decode()}")


class Object:
    """An object of the library, destroyed with this one."""

    def __init__(self, kind, make, *arguments):
        self.kind, self.handle = kind, pointer()
        call(make, *arguments, ctypes.byref(self.handle))

    def __del__(self):
        getattr(library, f"zs_{self.kind}_destroy")(self.handle)


def photo(path):
    """A picture file as an array [height, width, 3] of uint8."""
    opened, image = Object("photo", "zs_photo_open", os.fsencode(path)), Image()
    call("zs_photo_get_image", opened.handle, ctypes.byref(image))
    data = (ctypes.c_uint8 * (3 * image.width * image.height)).from_address(image.pixels)
    return np.ctypeslib.as_array(data).reshape(image.height, image.width, 3).copy()


def reconstruct(model, pictures, ratio=1.0):
    pictures = [np.ascontiguousarray(p, np.uint8 if p.dtype == np.uint8 else np.float32) for p in pictures]
    images = (Image * len(pictures))(*(
        Image(p.ctypes.data, p.strides[0], p.shape[1], p.shape[0], RGB8 if p.dtype == np.uint8 else RGB_F32, 0)
        for p in pictures))
    options = ReconstructOptions()
    call("zs_reconstruct_options_default", ctypes.byref(options), ctypes.c_size_t(ctypes.sizeof(options)))
    options.ratio = ratio
    count = ctypes.c_size_t(len(pictures))
    return Object("scene", "zs_reconstruct", model.handle, images, count, ctypes.byref(options))


def gaussians(scene):
    """A scene as a dictionary of arrays."""
    info = SceneInfo(struct_size=ctypes.sizeof(SceneInfo))
    call("zs_scene_get_info", scene.handle, ctypes.byref(info))
    n, k = info.count, (info.sh_degree + 1) ** 2
    shapes = fields(means=(n, 3), scales=(n, 3), quats=(n, 4), opacities=(n,), sh_coeffs=(n, k, 3))
    arrays = {name: np.empty(shape, np.float32) for name, shape in shapes}
    pointers = {name: array.ctypes.data for name, array in arrays.items()}
    given = Gaussians(ctypes.sizeof(Gaussians), info.sh_degree, n, **pointers)
    call("zs_scene_read", scene.handle, ctypes.byref(given))
    return arrays


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    context = Object("context", "zs_context_create", None)
    network = Object("model", "zs_model_open", context.handle, os.fsencode(sys.argv[1]), None)
    result = reconstruct(network, [photo(path) for path in sys.argv[3:]], ratio=0.5)
    call("zs_scene_save", result.handle, os.fsencode(sys.argv[2]), None)
    for name, array in gaussians(result).items():
        print(f"{name:10} {str(array.shape):14} from {array.min():.3f} to {array.max():.3f}")
