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
 * Ownership. The caller owns every object from zs_..._create, _open, _load, _from_..., _to_...,
 * zs_reconstruct, zs_refine_... and zs_depth_predict. Destroy it once, on any thread, when no call
 * uses it. Destroying NULL does nothing. Objects share ownership of their dependencies, so the
 * order of destruction is free. Your own Vulkan handles must outlive every object created on them.
 * Pointer arguments are accessed only during the call unless documented otherwise. Never free a
 * pointer that a call returned to an object's memory.
 *
 * Threads. Threads can share all objects. An internal lock of each zs_renderer serializes its
 * calls; calls on one zs_model run in parallel, at the cost of memory. Callbacks run on the
 * calling thread; no longjmp and no C++ exception may leave them. A thread pool prepares photos,
 * weights and files. It has RAYON_NUM_THREADS threads, by default one per core, and lives as long
 * as the process.
 *
 * Cache. The library caches kernel self-test results and the tile sizes of `zipsplat doctor tune`
 * on disk. The folder is ZIPSPLAT_CACHE, else `zipsplat` in XDG_CACHE_HOME or LOCALAPPDATA, else
 * .cache/zipsplat in HOME. Without a writable folder every process repeats the test. Adopted
 * devices (zs_device_from_vulkan) and ZS_PRECISION_FP32 need no cache.
 *
 * Structures. Later versions may append fields to a structure that begins with struct_size.
 * Initialize it with ZS_INIT, in every element of an array and also for outputs: all other fields
 * are then 0 or NULL, which is the default of every field. NULL options are the defaults. A library
 * accepts structures of its own and all earlier versions with the same ZS_ABI_VERSION and rejects
 * larger ones. Other structures never change.
 *
 * Values. Strings are UTF-8. Unknown enumeration values are rejected. Sizes are in bytes, counts in
 * elements, image sides in pixels.
 *
 * World. Axes are x right, y down, z forward. A scene from photos is in the world of their
 * cameras. Without known cameras it is in the first photo's camera space, and its scale is not
 * metric: the median distance from the first camera to visible surfaces is about 1. Scenes from
 * files and arrays keep their own world.
 *
 * Reproducibility. Equal calls on the same device and driver give bitwise equal results.
 */
