/*
 * zipsplat.h: reconstructs scenes of 3D Gaussians from unposed photos and renders them, on Vulkan.
 *
 * Generated from engine/bindings/c/src. Copyright and license: see LICENSE (Apache-2.0).
 *
 *     zs_device           an open device
 *     zs_model            a network with its weights on the device
 *     zs_reconstruction   Gaussians on the device, with tokens and cameras
 *     zs_scene            Gaussians in host memory, from a reconstruction, a file or arrays
 *     zs_renderer         a scene on the device
 *     zs_depth_model      a depth network with its weights on the device
 *     zs_depth_result     depth and cameras of photos
 *     zs_image_buffer     a decoded photo
 *     zs_capture          photos and their cameras, from transforms.json, COLMAP or arrays
 *     zs_blob             an encoded scene file in memory
 *
 * Errors. Functions that can fail return a zs_status: ZS_OK is 0, any other value a failure.
 * zs_last_error returns the calling thread's message. A failed call leaves no partial object; a
 * constructor sets its output to NULL. No C++ exception and no Rust panic crosses this interface.
 * Only exhausted host memory ends the process.
 *
 * Ownership. The caller owns the objects that calls create. Destroy them once, on any thread and in
 * any order, when no call uses them; destroying NULL does nothing. Your own Vulkan handles must
 * outlive all objects created on them. Strings and arrays in outputs are in the object's memory:
 * never free them. Pointer arguments are accessed only during the call unless documented otherwise.
 *
 * Threads. Threads can share all objects. A lock in each zs_renderer serializes its calls; calls on
 * one zs_model run in parallel, at the cost of memory. Callbacks run on the calling thread; no
 * longjmp and no C++ exception may leave them. A thread pool of RAYON_NUM_THREADS threads, by
 * default one per core, prepares photos, weights and files. It lives as long as the process.
 *
 * Cache. The library caches self-test results of kernels, tile sizes of `zipsplat doctor tune` and
 * LPIPS weights in the folder ZIPSPLAT_CACHE, else `zipsplat` in XDG_CACHE_HOME or LOCALAPPDATA,
 * else .cache/zipsplat in HOME. Without a writable folder every process repeats the test. Adopted
 * devices (zs_device_from_vulkan) and ZS_PRECISION_FP32 need no cache.
 *
 * Structures. Later versions may append fields to a structure that begins with struct_size.
 * Initialize it with ZS_INIT, also in arrays and for outputs: all other fields are then 0 or NULL,
 * their default. Fields named `reserved` stay 0. NULL options are the defaults. A library accepts
 * structures of its own and all earlier versions with the same ZS_ABI_VERSION and rejects larger
 * ones. Other structures never change.
 *
 * Values. Strings are UTF-8, warnings one per line. Unknown enumeration values are rejected. Sizes
 * are in bytes, counts in elements, image sides in pixels. Existing files are replaced atomically.
 *
 * World. Axes are x right, y down, z forward. A scene from photos is in the world of their cameras.
 * Without known cameras it is in the first photo's camera space, and its scale is not metric: the
 * median distance from the first camera to visible surfaces is about 1. Scenes from files and
 * arrays keep their own world.
 *
 * Reproducibility. Equal calls on the same device and driver give bitwise equal results.
 */
