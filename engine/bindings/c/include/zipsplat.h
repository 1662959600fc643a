/*
 * zipsplat.h: reconstructs scenes of 3D Gaussians from unposed photos and renders them, on Vulkan.
 *
 * Copyright and license: see LICENSE (Apache-2.0).
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
 * Errors. Functions that can fail return a zs_status, ZS_OK on success; zs_last_error returns the
 * calling thread's message. A failed call leaves no partial object; a constructor sets its output
 * to NULL. No C++ exception or Rust panic crosses this interface. Only exhausted host memory ends
 * the process.
 *
 * Ownership. The caller owns created objects and destroys them once, on any thread and in any
 * order, when no call uses them; destroying NULL does nothing. Your Vulkan handles must outlive all
 * objects created on them. Strings and arrays in outputs belong to the object: never free them.
 * Pointer arguments are accessed only during the call unless documented otherwise.
 *
 * Threads. Threads can share all objects. A lock in each zs_renderer serializes its calls; calls on
 * one zs_model run in parallel, at the cost of memory. Callbacks run on the calling thread; no
 * longjmp or C++ exception may leave them. A pool of RAYON_NUM_THREADS threads, by default one per
 * core, prepares photos, weights and files until the process ends.
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
 * World. Axes are x right, y down, z forward. A scene from photos is in their known cameras' world,
 * else in the first photo's camera space. There the scale is not metric: the median distance from
 * the first camera to visible surfaces is about 1. Scenes from files and arrays keep their world.
 *
 * Reproducibility. Equal calls on the same device and driver give bitwise equal results.
 */

#ifndef ZIPSPLAT_H
#define ZIPSPLAT_H

#include <stddef.h>
#include <stdint.h>

// A 32-bit enumeration: a type of its own in C++ and C23, an integer in older C.
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
#define ZS_ENUM(name) enum name : int32_t; typedef enum name name; enum name : int32_t
#else
#define ZS_ENUM(name) typedef int32_t name; enum name
#endif

// A structure with its size set and defaults: `zs_camera camera = ZS_INIT(zs_camera);`.
#ifdef __cplusplus
#define ZS_INIT(type) ([] { type value_{}; value_.struct_size = sizeof(type); return value_; }())
#else
#define ZS_INIT(type) ((type){.struct_size = sizeof(type)})
#endif

#ifdef __cplusplus
extern "C" {
#endif

/***************/
/*  Versions.  */
/***************/

// Version of this header's library: fixes raise the patch number, additions the minor one.
#define ZS_VERSION_MAJOR 0

// See ZS_VERSION_MAJOR.
#define ZS_VERSION_MINOR 2

// See ZS_VERSION_MAJOR.
#define ZS_VERSION_PATCH 0

// ABI version, also in the shared library's file name. Incompatible changes raise it.
#define ZS_ABI_VERSION 2

// Returns the library's ABI version. If it is not ZS_ABI_VERSION, call nothing else.
uint32_t zs_abi_version(void);

// Returns the library's version, as "0.2.0".
const char *zs_version(void);

/*******************/
/*  Status codes.  */
/*******************/

// Result of a call. Treat unknown values as failures.
ZS_ENUM(zs_status) {
    // Success.
    ZS_OK = 0,
    // An argument is invalid.
    ZS_ERROR_ARGUMENT = 1,
    // A file could not be opened, read or written.
    ZS_ERROR_IO = 2,
    // A file or buffer violates its format.
    ZS_ERROR_FORMAT = 3,
    // A checkpoint's tensors do not match its network.
    ZS_ERROR_WEIGHTS = 4,
    // No Vulkan loader, driver or suitable device.
    ZS_ERROR_NO_DEVICE = 5,
    // Too little device or host memory; nothing was submitted.
    ZS_ERROR_OUT_OF_MEMORY = 6,
    // The driver or the validation layer reported an error.
    ZS_ERROR_DRIVER = 7,
    // The device was reset or removed. Destroy its objects and create a new one. Scenes survive.
    ZS_ERROR_DEVICE_LOST = 8,
    // The progress callback canceled the call.
    ZS_ERROR_CANCELLED = 9,
    // Not available in this build.
    ZS_ERROR_UNSUPPORTED = 10,
    // A bug in the library. Destroy the call's objects; others stay usable.
    ZS_ERROR_INTERNAL = 11,
};

// Returns a status's name, or "unknown status".
const char *zs_status_name(int32_t status);

// Returns the message of the calling thread's last failure, or "", at most 16 KiB. The pointer
// stays valid until the thread ends; the next failure overwrites the text.
const char *zs_last_error(void);

/***************/
/*  Progress.  */
/***************/

// Answer of a progress callback.
ZS_ENUM(zs_progress_action) {
    // Continues.
    ZS_CONTINUE = 0,
    // Ends a refinement early with the best scene so far; cancels other calls.
    ZS_STOP = 1,
    // Cancels: the call fails with ZS_ERROR_CANCELLED.
    ZS_CANCEL = 2,
};

// Progress of a call. Only refinements set the fields from `step` on.
typedef struct zs_progress {
    // Size in the library's version.
    uint32_t struct_size;
    uint32_t reserved;
    // Completed fraction of the call, 0 to 1.
    double fraction;
    // Name of the current stage.
    const char *stage;
    // Completed steps.
    size_t step;
    // Total steps.
    size_t steps;
    // Mean loss of the last step.
    double loss;
    // Latest held-out PSNR in dB, or NaN.
    double psnr;
    // Estimated seconds left.
    double eta_seconds;
} zs_progress;

// Progress callback; `progress` is valid during it. It may call zs_ functions, except on the call's
// own objects. Unknown answers cancel.
typedef zs_progress_action (*zs_progress_callback)(void *user_data, const struct zs_progress *progress);

/**************/
/*  Devices.  */
/**************/

// Kinds of devices.
ZS_ENUM(zs_device_kind) {
    // Virtual or unknown.
    ZS_DEVICE_OTHER = 0,
    // Discrete GPU.
    ZS_DEVICE_DISCRETE = 1,
    // Integrated GPU.
    ZS_DEVICE_INTEGRATED = 2,
    // CPU (lavapipe).
    ZS_DEVICE_CPU = 3,
};

// An open Vulkan device.
typedef struct zs_device zs_device;

// Description of a device. Strings are truncated to fit.
typedef struct zs_device_info {
    uint32_t struct_size;
    // Number for zs_device_options.device; 0 if adopted.
    uint32_t index;
    // 1 if the engine can use the device.
    uint32_t usable;
    // Kind.
    zs_device_kind kind;
    // Device-local memory.
    uint64_t memory_bytes;
    // Name.
    char name[256];
    // Driver name and version.
    char driver[256];
    // Missing requirements; "" if usable.
    char unusable_reason[512];
    // UUID as 32 hexadecimal digits, as in nvidia-smi.
    char uuid[40];
} zs_device_info;

// Options of zs_device_create.
typedef struct zs_device_options {
    uint32_t struct_size;
    // 1 enables the Khronos validation layer, whose messages fail calls with ZS_ERROR_DRIVER, as
    // does ZIPSPLAT_VALIDATION=1 in the environment.
    uint32_t validation;
    // Device memory budget, checked before submission; 0 is unlimited.
    uint64_t max_memory_bytes;
    // Device number, part of its name, or UUID with or without "GPU-" and hyphens. NULL: the best.
    const char *device;
    // Cache folder; "" disables caching. NULL is the default (see Cache).
    const char *cache_dir;
} zs_device_options;

// Counts Vulkan devices, usable or not.
zs_status zs_device_count(size_t *count);

// Describes device `index`, less than zs_device_count.
zs_status zs_device_get(size_t index, struct zs_device_info *info);

// Opens a device with its own instance and queue.
zs_status zs_device_create(const struct zs_device_options *options, struct zs_device **device);

// Describes an open device.
zs_status zs_device_get_info(const struct zs_device *device, struct zs_device_info *info);

// Destroys a device, which closes with its last model and renderer.
void zs_device_destroy(struct zs_device *device);

/**************/
/*  Cameras.  */
/**************/

// A pinhole camera with OpenCV axes. Intrinsics are in pixels, with centers at +0.5.
typedef struct zs_camera {
    uint32_t struct_size;
    uint32_t reserved;
    // Width.
    uint32_t width;
    // Height.
    uint32_t height;
    // Horizontal focal length.
    double fx;
    // Vertical focal length.
    double fy;
    // Principal point, from the left edge.
    double cx;
    // Principal point, from the top edge.
    double cy;
    // Camera-to-world rotation, row-major; columns right, down, forward.
    double rotation[9];
    // Camera center.
    double translation[3];
} zs_camera;

/*************/
/*  Images.  */
/*************/

// Pixel formats. Color is sRGB-encoded, from 0 to 1 or 255.
ZS_ENUM(zs_pixel_format) {
    // VK_FORMAT_R8G8B8A8_UNORM.
    ZS_PIXEL_RGBA8 = 0,
    // 3 bytes: red, green, blue.
    ZS_PIXEL_RGB8 = 1,
    // VK_FORMAT_B8G8R8A8_UNORM.
    ZS_PIXEL_BGRA8 = 2,
    // 3 f32: red, green, blue.
    ZS_PIXEL_RGB_F32 = 3,
    // VK_FORMAT_R32G32B32A32_SFLOAT.
    ZS_PIXEL_RGBA_F32 = 4,
};

// A decoded photo.
typedef struct zs_image_buffer zs_image_buffer;

// Masks of photos' files.
typedef struct zs_masks {
    uint32_t struct_size;
    // 0: pixels of 0 are ignored; 1: the others.
    uint32_t inverted;
    // Folder of PNGs of the photos' sizes, without EXIF orientation, and names: 1.png or 1.jpg.png
    // for 1.jpg. NULL: the photos' alpha channels.
    const char *folder;
} zs_masks;

// A photo in the caller's memory, top row first. Alpha is dropped; f32 values are clamped to 0..1
// and rounded to 8 bits.
typedef struct zs_image {
    uint32_t struct_size;
    // Pixel format.
    zs_pixel_format format;
    // 1 to 32768.
    uint32_t width;
    // 1 to 32768.
    uint32_t height;
    // Bytes between rows: negative for bottom-up storage, 0 for contiguous rows.
    int64_t stride;
    // First pixel of the top row, of any alignment.
    const void *pixels;
    // Byte per pixel, top row first, or NULL: 0 ignores a pixel in reconstruction and refinement.
    const uint8_t *mask;
    // As `stride`, for the mask.
    int64_t mask_stride;
    // height x width, for zs_refine_options.depth_loss: known depth along the camera's z axis, 0
    // if unknown; or NULL.
    const float *depth;
} zs_image;

// Values of a camera's picture, in pixels or in cells of several pixels.
typedef struct zs_pixel_values {
    uint32_t struct_size;
    // Cells per row.
    uint32_t width;
    // Rows of cells.
    uint32_t height;
    uint32_t reserved;
    // height x width x channels. Cells with a NaN do not count.
    const float *values;
} zs_pixel_values;

// Opens a PNG, JPEG or WebP. Applies the EXIF orientation, drops alpha and keeps the high byte of
// 16-bit samples. For COLMAP cameras, which refer to unrotated pixels, use zs_capture_open_image.
zs_status zs_image_buffer_open(const char *path, struct zs_image_buffer **photo);

// As zs_image_buffer_open, with the photo's mask.
zs_status zs_image_buffer_open_masked(const char *path, const struct zs_masks *masks, struct zs_image_buffer **photo);

// As zs_image_buffer_open, from memory.
zs_status zs_image_buffer_from_memory(const void *data, size_t size, struct zs_image_buffer **photo);

// Returns the pixels, as ZS_PIXEL_RGB8, and the mask, if any.
zs_status zs_image_buffer_get_image(const struct zs_image_buffer *photo, struct zs_image *image);

// Destroys a photo.
void zs_image_buffer_destroy(struct zs_image_buffer *photo);

// Writes an 8-bit RGB PNG.
zs_status zs_image_save_png(const struct zs_image *image, const char *path);

/***************/
/*  Captures.  */
/***************/

// Photos with known cameras.
typedef struct zs_capture zs_capture;

// A photo of a capture.
typedef struct zs_capture_view {
    uint32_t struct_size;
    uint32_t reserved;
    // Name in the file.
    const char *name;
    // Path of the photo; NULL if not found.
    const char *path;
    // Undistorted pinhole camera.
    const struct zs_camera *camera;
} zs_capture_view;

// Description of a capture.
typedef struct zs_capture_info {
    uint32_t struct_size;
    uint32_t reserved;
    // Number of photos.
    size_t view_count;
    // Warnings about ignored data.
    const char *warnings;
} zs_capture_info;

// Opens a capture: a transforms.json (instant-ngp, nerfstudio), a COLMAP model folder, or a folder
// that contains either. World and scale stay the file's. Photos are read only for sizes that the
// file lacks. Photos of lenses wider than 110 degrees have several adjacent views of one name.
zs_status zs_capture_open(const char *path, struct zs_capture **capture);

// Creates a capture from copies of pinhole cameras. Paths may be NULL.
zs_status zs_capture_create(const struct zs_capture_view *views, size_t count, struct zs_capture **capture);

// Writes cameras, lenses and photo paths as a transforms.json (nerfstudio).
zs_status zs_capture_save(const struct zs_capture *capture, const char *path);

// Describes a capture.
zs_status zs_capture_get_info(const struct zs_capture *capture, struct zs_capture_info *info);

// Returns photo `index`.
zs_status zs_capture_get_view(const struct zs_capture *capture, size_t index, struct zs_capture_view *view);

// Finds the photo at `path` by file name, then by the longest common path suffix. Without a match
// `index` is the number of photos. An ambiguous match is a ZS_ERROR_ARGUMENT.
zs_status zs_capture_find(const struct zs_capture *capture, const char *path, size_t *index);

// Opens photo `index` undistorted, ignoring the EXIF orientation, from `path`; NULL: the capture's.
zs_status zs_capture_open_image(const struct zs_capture *capture,
                                size_t index,
                                const char *path,
                                struct zs_image_buffer **photo);

// As zs_capture_open_image, with the photo's mask.
zs_status zs_capture_open_masked_image(const struct zs_capture *capture,
                                       size_t index,
                                       const char *path,
                                       const struct zs_masks *masks,
                                       struct zs_image_buffer **photo);

// Destroys a capture.
void zs_capture_destroy(struct zs_capture *capture);

/*************/
/*  Scenes.  */
/*************/

// World of a scene.
ZS_ENUM(zs_world) {
    // ZS_WORLD_INPUT_CAMERAS with known cameras, else ZS_WORLD_FIRST_CAMERA.
    ZS_WORLD_AUTO = 0,
    // The first photo's camera space.
    ZS_WORLD_FIRST_CAMERA = 1,
    // The world of `cameras`, which are required.
    ZS_WORLD_INPUT_CAMERAS = 2,
};

// Bytes of the library, such as an encoded scene file.
typedef struct zs_blob zs_blob;

// 3D Gaussians in host memory, which survive device loss.
typedef struct zs_scene zs_scene;

// Description of a scene.
typedef struct zs_scene_info {
    uint32_t struct_size;
    // World that the file states, or ZS_WORLD_AUTO.
    zs_world world;
    // Number of Gaussians.
    size_t gaussian_count;
    // Number of Gaussians dropped by `drop_invalid`.
    size_t dropped_count;
} zs_scene_info;

// Gaussians as one array per property.
typedef struct zs_gaussians {
    uint32_t struct_size;
    // Degree of spherical harmonics, 0 to 3: K = (sh_degree + 1)^2 coefficients per channel.
    uint32_t sh_degree;
    // N.
    size_t count;
    // N x 3 centers.
    const float *means;
    // N x 3 linear standard deviations, not negative.
    const float *scales;
    // N x 4 quaternions w, x, y, z of any length but zero.
    const float *quats;
    // N opacities from 0 to 1.
    const float *opacities;
    // N x K x 3 coefficients of spherical harmonics for red, green, blue, as in 3D Gaussian
    // Splatting. The basis is real and orthonormal, by band, then m = -l to l, negative for odd m:
    // 0.282095, -0.488603 y, 0.488603 z, -0.488603 x, ... for the unit vector (x, y, z) in the
    // world from the camera to the Gaussian's center. Color is max(0, 0.5 + sum of basis times
    // coefficients).
    const float *sh_coeffs;
    // 1 if the scene was optimized with opacity compensation, else 0; see zs_antialiasing.
    uint32_t antialiased;
    uint32_t reserved;
} zs_gaussians;

// Options for reading scenes.
typedef struct zs_scene_open_options {
    uint32_t struct_size;
    // 1 drops NaN, infinite and out-of-range Gaussians; 0 rejects them.
    uint32_t drop_invalid;
    // Format in memory: "splat", "sog" or "gltf"; NULL for others and for files.
    const char *format;
} zs_scene_open_options;

// Options for writing scenes.
typedef struct zs_scene_save_options {
    uint32_t struct_size;
    // SPZ version: 2, 3 or 4 (zstd); 0 is 3.
    uint32_t spz_version;
} zs_scene_save_options;

// Describes a scene.
zs_status zs_scene_get_info(const struct zs_scene *scene, struct zs_scene_info *info);

// Returns the scene's arrays.
zs_status zs_scene_get_gaussians(const struct zs_scene *scene, struct zs_gaussians *gaussians);

// Creates a scene from copies of arrays. All are required, with finite values in their range.
zs_status zs_scene_create(const struct zs_gaussians *gaussians, struct zs_scene **scene);

// Creates a scene with a Gaussian per point, as an initialization for zs_refine_scene. `positions`
// is N x 3; `colors` is N x 3 in red, green, blue, or NULL for gray. `cameras` limit the
// Gaussians' sizes; their count may be 0.
zs_status zs_scene_from_points(const float *positions,
                               const uint8_t *colors,
                               size_t count,
                               const struct zs_camera *cameras,
                               size_t camera_count,
                               struct zs_scene **scene);

// As zs_scene_from_points, also with Gaussians where stereo between the cameras' photos finds
// surfaces without points.
zs_status zs_scene_from_photos(const struct zs_image *images,
                               const struct zs_camera *cameras,
                               size_t image_count,
                               const float *positions,
                               const uint8_t *colors,
                               size_t count,
                               struct zs_scene **scene);

// Opens a PLY of 3D Gaussian Splatting, .compressed.ply, SPZ, .sog, .splat, or glTF with
// KHR_gaussian_splatting (.gltf, .glb).
zs_status zs_scene_open(const char *path, const struct zs_scene_open_options *options, struct zs_scene **scene);

// As zs_scene_open, from memory. A glTF must not refer to other files.
zs_status zs_scene_from_memory(const void *data,
                               size_t size,
                               const struct zs_scene_open_options *options,
                               struct zs_scene **scene);

// Writes a scene in the format of the extension: .ply, .spz, .sog, .splat, .gltf or .glb. Keeps an
// opened file's world.
zs_status zs_scene_save(const struct zs_scene *scene, const char *path, const struct zs_scene_save_options *options);

// Encodes a scene as "ply", "spz", "sog", "splat", "gltf" or "glb".
zs_status zs_scene_to_memory(const struct zs_scene *scene,
                             const char *format,
                             const struct zs_scene_save_options *options,
                             struct zs_blob **bytes);

// Returns the bytes.
zs_status zs_blob_get(const struct zs_blob *bytes, const void **data, size_t *size);

// Destroys bytes.
void zs_blob_destroy(struct zs_blob *bytes);

// Destroys a scene.
void zs_scene_destroy(struct zs_scene *scene);

/************/
/*  Edits.  */
/************/

// Kind of an edit, with its numbers. Lengths are in world units.
ZS_ENUM(zs_edit_kind) {
    // Keeps centers in a box: lower corner x, y, z, upper corner x, y, z.
    ZS_EDIT_CROP_BOX = 0,
    // Keeps centers in a sphere: center x, y, z, radius.
    ZS_EDIT_CROP_SPHERE = 1,
    // Moves the scene: x, y, z.
    ZS_EDIT_TRANSLATE = 2,
    // Rotates about the origin: degrees about x, then y, then z.
    ZS_EDIT_ROTATE = 3,
    // Scales about the origin: factor.
    ZS_EDIT_SCALE = 4,
    // Rotates about the origin: the cameras' mean up becomes -y.
    ZS_EDIT_LEVEL = 5,
    // Drops smaller opacities: opacity.
    ZS_EDIT_MIN_OPACITY = 6,
    // Drops larger Gaussians: largest standard deviation.
    ZS_EDIT_MAX_SIZE = 7,
    // Drops isolated Gaussians: least number of others, radius.
    ZS_EDIT_MIN_NEIGHBORS = 8,
    // Drops Gaussians whose centers are in few cameras' pictures: least number of cameras.
    ZS_EDIT_MIN_VIEWS = 9,
    // Drops floaters: faint or isolated Gaussians; with cameras, also those far outside pictures.
    ZS_EDIT_CLEAN = 10,
    // Lowers the degree of spherical harmonics: degree.
    ZS_EDIT_SH_DEGREE = 11,
    // Merges similar neighbors: number of Gaussians left, or a fraction below 1.
    ZS_EDIT_DECIMATE = 12,
    // Sorts by opacity times the two largest scales, largest first.
    ZS_EDIT_SORT = 13,
};

// An edit.
typedef struct zs_edit {
    uint32_t struct_size;
    // Kind.
    zs_edit_kind kind;
    // Numbers of the kind; the others are 0.
    double numbers[6];
} zs_edit;

// Merges `scenes`, one or more in one world, all antialiased or none, and applies `edits` in order.
// `cameras`, in that world, are for ZS_EDIT_LEVEL, ZS_EDIT_MIN_VIEWS and ZS_EDIT_CLEAN; edits that
// move the scene move them, too. `gaussian_counts`, unless NULL, gets the number of Gaussians after
// each edit. `sources`, unless NULL, gets each resulting Gaussian's index among those of all
// `scenes`; of several merged, the most visible. It needs room for all. Edits that leave none fail.
zs_status zs_scene_edit(const struct zs_scene *const *scenes,
                        size_t scene_count,
                        const struct zs_edit *edits,
                        size_t edit_count,
                        const struct zs_camera *cameras,
                        size_t camera_count,
                        size_t *gaussian_counts,
                        size_t *sources,
                        struct zs_scene **scene);

/*************/
/*  Models.  */
/*************/

// Number formats of the network. Geometry is f32. Unsupported precisions and those that fail the
// self-test are rejected.
ZS_ENUM(zs_precision) {
    // ZS_PRECISION_FP16 if the GPU's matrix units pass the self-test, else ZS_PRECISION_FP32.
    ZS_PRECISION_AUTO = 0,
    // f32 throughout.
    ZS_PRECISION_FP32 = 1,
    // f16 matrix products, otherwise f32.
    ZS_PRECISION_FP16 = 2,
    // bf16 matrix products, otherwise f32.
    ZS_PRECISION_BF16 = 3,
    // 8-bit linear layers of blocks, otherwise as ZS_PRECISION_FP16.
    ZS_PRECISION_INT8 = 4,
};

// A network on a device.
typedef struct zs_model zs_model;

// Options of zs_model_load.
typedef struct zs_model_options {
    uint32_t struct_size;
    // Number formats.
    zs_precision precision;
    // Variant of a checkpoint that does not name its own: "vitg", "vits", "vitb", "vitl", "da3s",
    // "da3b" or "da3l", and missing parameters, as in
    // "vits:out_layers=5,7,11:alt_start=5:rope_start=5".
    const char *variant;
    // Progress callback.
    zs_progress_callback progress;
    // Argument of `progress`.
    void *user_data;
    // 1 enables ZS_REFINE_TARGET_TOKENS: an f32 head and each scene's tokens stay on the device.
    uint32_t tokens;
    uint32_t reserved;
} zs_model_options;

// Description of a model.
typedef struct zs_model_info {
    uint32_t struct_size;
    // Native side of the square input.
    uint32_t image_size;
    // Patch side, which divides the sides of input images.
    uint32_t patch_size;
    // Gaussians per token; at ratio 1 every patch is a token.
    uint32_t gaussians_per_token;
    // Degree of spherical harmonics.
    uint32_t sh_degree;
    // Number formats in use.
    zs_precision precision;
    // Device memory of the weights.
    uint64_t weight_bytes;
    // Unusable GPUs, kernels that failed their self-test (which can reduce ZS_PRECISION_AUTO to
    // ZS_PRECISION_FP32), assumptions about the weights.
    const char *warnings;
} zs_model_info;

// Loads a checkpoint: safetensors or a PyTorch archive at `path`, the built-in model for "builtin"
// (ZS_ERROR_UNSUPPORTED in builds without one), or random weights for "seeded:VARIANT".
zs_status zs_model_load(const struct zs_device *device,
                        const char *path,
                        const struct zs_model_options *options,
                        struct zs_model **model);

// As zs_model_load, from memory.
zs_status zs_model_from_memory(const struct zs_device *device,
                               const void *data,
                               size_t size,
                               const struct zs_model_options *options,
                               struct zs_model **model);

// Describes a model.
zs_status zs_model_get_info(const struct zs_model *model, struct zs_model_info *info);

// Destroys a model.
void zs_model_destroy(struct zs_model *model);

/**********************/
/*  Reconstructions.  */
/**********************/

// A reconstruction's Gaussians on its device, with their relation to the photos.
typedef struct zs_reconstruction zs_reconstruction;

// Description of a reconstruction.
typedef struct zs_reconstruction_info {
    uint32_t struct_size;
    // 1 if ZS_REFINE_TARGET_TOKENS is possible.
    uint32_t has_tokens;
    // Number of photos.
    size_t view_count;
    // Number of kept tokens.
    size_t token_count;
    // Number of Gaussians.
    size_t gaussian_count;
    // Warnings.
    const char *warnings;
    // Channels of zs_reconstruction_get_patch_tokens; 0 without features.
    size_t channel_count;
} zs_reconstruction_info;

// Estimated camera of a photo.
typedef struct zs_camera_estimate {
    uint32_t struct_size;
    // Number of patches that agree with the camera.
    uint32_t inliers;
    // Number of patches.
    uint32_t patches;
    uint32_t reserved;
    // Camera of the whole photo in the scene's world; NULL without an estimate.
    const struct zs_camera *camera;
} zs_camera_estimate;

// Describes a reconstruction.
zs_status zs_reconstruction_get_info(const struct zs_reconstruction *reconstruction,
                                     struct zs_reconstruction_info *info);

// Returns the patch tokens of the backbone's last layer, a cell per patch, for photo `index`'s
// center crop with the aspect ratio of the network's input.
zs_status zs_reconstruction_get_patch_tokens(const struct zs_reconstruction *reconstruction,
                                             size_t index,
                                             struct zs_pixel_values *tokens);

// Reads the scene from the device.
zs_status zs_reconstruction_to_scene(const struct zs_reconstruction *reconstruction, struct zs_scene **scene);

// Estimates the camera of photo `index` from its patches' Gaussians. The first call estimates all,
// with one field of view. Fails if no photo has an estimate, or for known cameras.
zs_status zs_reconstruction_estimate_camera(const struct zs_reconstruction *reconstruction,
                                            size_t index,
                                            struct zs_camera_estimate *estimate);

// Destroys a reconstruction.
void zs_reconstruction_destroy(struct zs_reconstruction *reconstruction);

/****************************************/
/*  Reconstruction: photos to a scene.  */
/****************************************/

// Maximum number of photos of one pass.
#define ZS_MAX_VIEWS 192

// The paper's ratio: 0.5 sqrt(2 / number of photos).
#define ZS_RATIO_AUTO -1.0

// Scale estimated from the cameras and, if given, the capture's points.
#define ZS_SCENE_SCALE_AUTO 0.0

// Token selection at ratios below 1.
ZS_ENUM(zs_token_selection) {
    // The token nearest to each k-means centroid.
    ZS_TOKEN_SELECTION_KMEANS = 0,
    // Evenly spaced.
    ZS_TOKEN_SELECTION_STRIDE = 1,
    // Random, from `seed`.
    ZS_TOKEN_SELECTION_RANDOM = 2,
    // Fewest mutual nearest neighbors in earlier photos first.
    ZS_TOKEN_SELECTION_MUTUAL = 3,
};

// Options of zs_reconstruct.
typedef struct zs_reconstruct_options {
    uint32_t struct_size;
    // World of the scene.
    zs_world world;
    // Fraction of tokens that become Gaussians, in (0, 1], or ZS_RATIO_AUTO; 0 is 1.
    double ratio;
    // Length in units of `cameras` that the network treats as 1, or ZS_SCENE_SCALE_AUTO. The
    // network expects a median distance of about 1 from the first camera.
    double scene_scale;
    // Token selection.
    zs_token_selection token_selection;
    // 1 keeps the backbone's features on the device, for zs_reconstruct_again and
    // zs_reconstruction_get_patch_tokens.
    uint32_t keep_features;
    // Width and height of the network's input, multiples of the patch size; 0 and 0 are the
    // model's own. Photos are center-cropped and resized.
    uint32_t input_size[2];
    // Seed for ZS_TOKEN_SELECTION_RANDOM.
    uint64_t seed;
    // 0 or the number of photos.
    size_t camera_count;
    // Known cameras of the whole photos.
    const struct zs_camera *cameras;
    // Progress callback.
    zs_progress_callback progress;
    // Argument of `progress`.
    void *user_data;
    // Capture whose points and cameras give ZS_SCENE_SCALE_AUTO; NULL uses `cameras` alone.
    const struct zs_capture *capture;
    // Keys and values of attention across views: "1" to "4" for means of so many patches squared,
    // "local" for the own view only, "auto" for a rule by the number of views; "local/2" for the
    // first block and the others; with "+own" and "+first", the own and the first view are whole.
    // Fewer are faster and less exact. NULL is "1".
    const char *kv_pool;
    // Most photos of a pass, 1 to ZS_MAX_VIEWS; 0 is as many as device memory holds. More are split
    // into overlapping blocks, by camera position or order, and joined in one world. Several blocks
    // keep neither features nor tokens.
    uint32_t block_size;
    // Photos that neighboring blocks share; 0 is a quarter of the block.
    uint32_t block_overlap;
} zs_reconstruct_options;

// Reconstructs a scene from 1 to 65,536 photos of one place.
zs_status zs_reconstruct(const struct zs_model *model,
                         const struct zs_image *images,
                         size_t image_count,
                         const struct zs_reconstruct_options *options,
                         struct zs_reconstruction **reconstruction);

// Reconstructs a scene from the features of another reconstruction of the model, without another
// backbone pass, bitwise as zs_reconstruct. Of `options` only `ratio`, `token_selection`, `seed`
// and `progress` count.
zs_status zs_reconstruct_again(const struct zs_model *model,
                               const struct zs_reconstruction *reconstruction,
                               const struct zs_reconstruct_options *options,
                               struct zs_reconstruction **again);

/************/
/*  Depth.  */
/************/

// Source of estimated cameras.
ZS_ENUM(zs_camera_source) {
    // The camera decoder.
    ZS_CAMERA_SOURCE_DECODER = 0,
    // The ray maps, principal point included. Inconsistent rays give no camera.
    ZS_CAMERA_SOURCE_RAYS = 1,
};

// A Depth Anything 3 or VGGT network on a device.
typedef struct zs_depth_model zs_depth_model;

// Depth and cameras of photos.
typedef struct zs_depth_result zs_depth_result;

// Options of zs_depth_model_load.
typedef struct zs_depth_model_options {
    uint32_t struct_size;
    // Number formats.
    zs_precision precision;
    // Progress callback.
    zs_progress_callback progress;
    // Argument of `progress`.
    void *user_data;
} zs_depth_model_options;

// Description of a depth model.
typedef struct zs_depth_model_info {
    uint32_t struct_size;
    // 1 if it sees all photos at once and estimates cameras.
    uint32_t is_multi_view;
    // Patch side, which divides the sides of maps.
    uint32_t patch_size;
    // Number formats in use.
    zs_precision precision;
    // Device memory of the weights.
    uint64_t weight_bytes;
    // Unusable GPUs and failed kernels.
    const char *warnings;
} zs_depth_model_info;

// Options of zs_depth_predict.
typedef struct zs_depth_options {
    uint32_t struct_size;
    // Longer side of the network's input, for VGGT its width, 14 to 8192 pixels; 0 is 504, for
    // VGGT 518. Each side is rounded to a multiple of 14. Photos of different shapes are cropped
    // to their common center.
    uint32_t input_size;
    // Source of estimated cameras.
    zs_camera_source camera_source;
    // 1 estimates a focal length per photo, 0 a shared one for photos of equal size
    // (confidence-weighted median).
    uint32_t per_view_focal;
    // 0 or the number of photos.
    size_t camera_count;
    // Known cameras of the whole photos, for multi-view networks. They set the depth scale and are
    // returned unchanged.
    const struct zs_camera *cameras;
    // Progress callback.
    zs_progress_callback progress;
    // Argument of `progress`.
    void *user_data;
    // 1 keeps zs_depth_result_get_patch_tokens.
    uint32_t keep_features;
    uint32_t reserved;
} zs_depth_options;

// Description of a depth result.
typedef struct zs_depth_result_info {
    uint32_t struct_size;
    uint32_t reserved;
    // Number of photos.
    size_t view_count;
    // Channels of zs_depth_result_get_patch_tokens; 0 without features.
    size_t channel_count;
} zs_depth_result_info;

// Depth of a photo. Arrays are `[height][width]`.
typedef struct zs_depth_map {
    uint32_t struct_size;
    uint32_t reserved;
    // Width.
    uint32_t width;
    // Height.
    uint32_t height;
    // Distance along the camera's axis, in the cameras' scale, which all views share.
    const float *depth;
    // Confidence, at least 1; NULL from single-view networks.
    const float *confidence;
    // Sky score, at least 0, above 0.3 for sky; NULL from multi-view networks.
    const float *sky;
    // Camera of the map in the common world; NULL if unknown.
    const struct zs_camera *camera;
    // Camera of the whole photo; NULL if unknown.
    const struct zs_camera *image_camera;
} zs_depth_map;

// Loads Depth Anything 3 or VGGT: a released model.safetensors or model.pt at `path`, or random
// weights for "seeded:NAME", such as "seeded:da3-small".
zs_status zs_depth_model_load(const struct zs_device *device,
                              const char *path,
                              const struct zs_depth_model_options *options,
                              struct zs_depth_model **model);

// Describes a depth model.
zs_status zs_depth_model_get_info(const struct zs_depth_model *model, struct zs_depth_model_info *info);

// Destroys a depth model.
void zs_depth_model_destroy(struct zs_depth_model *model);

// Estimates depth of 1 to ZS_MAX_VIEWS photos of one place. Multi-view networks also estimate
// cameras, relative to one of them.
zs_status zs_depth_predict(const struct zs_depth_model *model,
                           const struct zs_image *images,
                           size_t image_count,
                           const struct zs_depth_options *options,
                           struct zs_depth_result **depths);

// Describes a depth result.
zs_status zs_depth_result_get_info(const struct zs_depth_result *depths, struct zs_depth_result_info *info);

// Returns the map of photo `index`.
zs_status zs_depth_result_get_map(const struct zs_depth_result *depths, size_t index, struct zs_depth_map *map);

// Returns the patch tokens of the backbone's last layer, a cell per patch of photo `index`'s map.
zs_status zs_depth_result_get_patch_tokens(const struct zs_depth_result *depths,
                                           size_t index,
                                           struct zs_pixel_values *tokens);

// Creates a scene with a Gaussian per confident pixel of each posed photo, in the cameras' world.
// Patches of 14 x 14 pixels keep their `max_gaussians_per_patch` most visible ones; 0 keeps all.
zs_status zs_depth_result_to_scene(const struct zs_depth_result *depths,
                                   uint32_t max_gaussians_per_patch,
                                   struct zs_scene **scene);

// Destroys a depth result.
void zs_depth_result_destroy(struct zs_depth_result *depths);

/*****************/
/*  Refinement.  */
/*****************/

// Holds out no photo.
#define ZS_HOLDOUT_VIEWS_NONE -1

// Optimized parameters.
ZS_ENUM(zs_refine_target) {
    // The scene's Gaussians.
    ZS_REFINE_TARGET_GAUSSIANS = 0,
    // The tokens behind the Gaussians; needs zs_model_options.tokens.
    ZS_REFINE_TARGET_TOKENS = 1,
};

// Whether to learn a color transform per photo.
ZS_ENUM(zs_exposure_mode) {
    // If a factor per photo and color explains much of the error after the first steps.
    ZS_EXPOSURE_AUTO = 0,
    // Never.
    ZS_EXPOSURE_OFF = 1,
    // After the first steps.
    ZS_EXPOSURE_ON = 2,
};

// Opacity compensation for blur (Mip-Splatting): fades Gaussians thinner than a pixel.
ZS_ENUM(zs_antialiasing) {
    // As zs_gaussians.antialiased.
    ZS_ANTIALIASING_AUTO = 0,
    // For scenes optimized that way.
    ZS_ANTIALIASING_ON = 1,
    // For other scenes.
    ZS_ANTIALIASING_OFF = 2,
};

// Known depth of images in the loss, zs_image.depth.
ZS_ENUM(zs_depth_loss) {
    // Not used.
    ZS_DEPTH_LOSS_OFF = 0,
    // In the scene's unit.
    ZS_DEPTH_LOSS_METRIC = 1,
    // Relative, as of a depth network: its inverse is fitted to each photo's rendered one by a
    // scale and a shift.
    ZS_DEPTH_LOSS_RELATIVE = 2,
};

// Reason for the end of a refinement.
ZS_ENUM(zs_stop_reason) {
    // All steps completed.
    ZS_STOP_REASON_FINISHED = 0,
    // The progress callback returned ZS_STOP.
    ZS_STOP_REASON_STOPPED = 1,
    // The loss grew, or became NaN or infinite.
    ZS_STOP_REASON_DIVERGED = 2,
    // A checkpoint could not be written or a step's memory allocated.
    ZS_STOP_REASON_UNSAVED = 3,
};

// Options of a refinement.
typedef struct zs_refine_options {
    uint32_t struct_size;
    // Optimizer steps; 0 uses `seconds`.
    uint32_t steps;
    // Photos per step, capped at the number of training photos; 0 is 4.
    uint32_t views_per_step;
    // Evenly spaced held-out photos, fewer than all, or ZS_HOLDOUT_VIEWS_NONE; 0 holds out one of
    // 40 or more, none with optimize_cameras. The step with their best PSNR is returned.
    int32_t holdout_views;
    // Maximum width and height in pixels; larger photos are downscaled. 0 is 1600, UINT32_MAX
    // keeps full size.
    uint32_t max_image_size[2];
    // Optimized parameters.
    zs_refine_target target;
    // 1 also optimizes the training photos' cameras, except the first.
    uint32_t optimize_cameras;
    // Weight of LPIPS (VGG) in the loss; 0 needs no LPIPS weights.
    float perceptual_weight;
    // Learned color transforms per photo. The scene has their mean.
    zs_exposure_mode exposure;
    // Seed of the photo order and of growth.
    uint64_t seed;
    // Final number of Gaussians; values up to the scene's number disable growth. 0 grows from 50
    // steps on and below a training PSNR of 25 dB, to one per 32 pixels of the photos and at most
    // 16 times the scene's, at 800 steps twice as many. Must be 0 for tokens.
    size_t max_gaussians;
    // Progress callback, called after each step.
    zs_progress_callback progress;
    // Argument of `progress`.
    void *user_data;
    // Approximate duration instead of `steps`; 0 without `steps` is 60. Timed steps determine
    // their number and the photos' size.
    double seconds;
    // Whether to draw and return an antialiased scene.
    zs_antialiasing antialiasing;
    // Known depth in the loss, by inverse depth.
    zs_depth_loss depth_loss;
    // Initial weight of depth, which falls to a hundredth; 0 is the default of the kind.
    float depth_weight;
    uint32_t reserved;
    // File of the state, written each minute and when stopped, or NULL. The same call resumes it.
    const char *checkpoint;
} zs_refine_options;

// Result of a refinement.
typedef struct zs_refine_result {
    uint32_t struct_size;
    // Reason for the end.
    zs_stop_reason stop_reason;
    // Completed steps.
    uint32_t steps;
    // Step of the returned scene; 0 if none improved it.
    uint32_t best_step;
    // Mean loss of the first step, at its resolution, or NaN.
    double initial_loss;
    // Mean loss of the last step, likewise.
    double final_loss;
    // Held-out PSNR in dB before the first step, or NaN.
    double initial_psnr;
    // Held-out PSNR in dB of the returned scene.
    double best_psnr;
    // Duration in seconds.
    double seconds;
    // Mean PSNR in dB of up to 16 full-size training photos before the first step.
    double initial_training_psnr;
    // The same for the returned scene.
    double best_training_psnr;
    // Output array for all photos' cameras, with struct_size set, or NULL.
    struct zs_camera *cameras;
    // Output array for the transforms from the scene's colors to all photos', or NULL: for each
    // the 3 rows of a matrix with offset, 12 numbers, the identity unless learned.
    float *exposures;
} zs_refine_result;

// Optimizes a copy of a scene to match `count` photos. `cameras` are of the whole photos, in the
// scene's world. An early stop or divergence still returns the best scene. `result` may be NULL.
zs_status zs_refine_scene(const struct zs_device *device,
                          const struct zs_scene *scene,
                          const struct zs_image *images,
                          const struct zs_camera *cameras,
                          size_t count,
                          const struct zs_refine_options *options,
                          struct zs_refine_result *result,
                          struct zs_scene **refined);

// As zs_refine_scene, for the Gaussians or tokens of a reconstruction.
zs_status zs_refine_reconstruction(const struct zs_reconstruction *reconstruction,
                                   const struct zs_image *images,
                                   const struct zs_camera *cameras,
                                   size_t count,
                                   const struct zs_refine_options *options,
                                   struct zs_refine_result *result,
                                   struct zs_scene **refined);

/****************/
/*  Renderers.  */
/****************/

// Depth along the camera's z axis, in world units.
ZS_ENUM(zs_depth_mode) {
    // Blended depth divided by alpha; 0 where alpha is 0.
    ZS_DEPTH_MODE_EXPECTED = 0,
    // Sum of depth times blending weight.
    ZS_DEPTH_MODE_ACCUMULATED = 1,
};

// A scene on a device. Caches recordings for the last four sizes and kinds of output.
typedef struct zs_renderer zs_renderer;

// Output buffers of a picture; NULL skips one.
typedef struct zs_render_buffers {
    uint32_t struct_size;
    uint32_t reserved;
    // As zs_image.stride; padding stays unchanged.
    int64_t stride;
    // As zs_image.pixels, in the options' format.
    void *pixels;
    // height x width: 0 to 1.
    float *alpha;
    // height x width, in world units.
    float *depth;
    // height x width x 3: unit normals in the world, toward the camera; 0 where empty.
    float *normals;
} zs_render_buffers;

// Options of pictures.
typedef struct zs_render_options {
    uint32_t struct_size;
    // 8-bit color is clamped and truncated, 8-bit alpha rounded, f32 unchanged. Color includes the
    // background's part; on black it is premultiplied.
    zs_pixel_format format;
    // Kind of zs_render_buffers.depth.
    zs_depth_mode depth;
    // Opacity compensation.
    zs_antialiasing antialiasing;
    // Background as red, green, blue.
    float background[3];
    // Culls Gaussians at smaller camera depth. 0 is 0.01, or less for scene extents below 0.1.
    float near_plane;
} zs_render_options;

// Creates a renderer and uploads `scene`, which may be NULL.
zs_status zs_renderer_create(const struct zs_device *device,
                             const struct zs_scene *scene,
                             struct zs_renderer **renderer);

// Replaces the scene, cheaply for an equal number of Gaussians and degree. After a failure, set a
// scene successfully before drawing.
zs_status zs_renderer_set_scene(struct zs_renderer *renderer, const struct zs_scene *scene);

// Replaces the scene by a reconstruction's Gaussians, without a copy to the host unless they are
// in the world of known cameras.
zs_status zs_renderer_set_reconstruction(struct zs_renderer *renderer, const struct zs_reconstruction *reconstruction);

// As zs_scene_create and zs_renderer_set_scene, without a zs_scene, for optimizers. An equal
// number of Gaussians and degree is updated in place.
zs_status zs_renderer_update_gaussians(struct zs_renderer *renderer, const struct zs_gaussians *gaussians);

// Destroys a renderer, after its copies to Vulkan targets.
void zs_renderer_destroy(struct zs_renderer *renderer);

// Draws a picture per camera. After a failure some pictures may be written.
zs_status zs_render(const struct zs_renderer *renderer,
                    const struct zs_camera *cameras,
                    const struct zs_render_buffers *pictures,
                    size_t count,
                    const struct zs_render_options *options);

/****************************/
/*  Gradients of pictures.  */
/****************************/

// Gradients of a loss with respect to one camera's outputs, in contiguous rows. NULL is 0.
typedef struct zs_grad_outputs {
    uint32_t struct_size;
    uint32_t reserved;
    // height x width x 3.
    const float *color;
    // height x width.
    const float *alpha;
    // height x width.
    const float *depth;
} zs_grad_outputs;

// Output buffers of gradients, which are overwritten; NULL skips one.
typedef struct zs_gradients {
    uint32_t struct_size;
    uint32_t reserved;
    // N x 3.
    float *means;
    // N x 3.
    float *scales;
    // N x 4, of unnormalized rotations.
    float *quats;
    // N.
    float *opacities;
    // N x K x 3.
    float *sh_coeffs;
    // count x 10: w x, y, z, v x, y, z, fx, fy, cx, cy. The camera-to-world pose moves as pose o
    // (exp(w^), v): R' = R exp(w^) and t' = t + R v.
    float *cameras;
    // count x N x 2: projected centers in pixels, at constant covariances.
    float *means2d;
} zs_gradients;

// Backpropagates `grad_outputs` of `count` cameras. Color is that of ZS_PIXEL_RGB_F32 for any
// format in the options. Zero-valued coefficients also get gradients.
//
// `scene` may differ from the renderer's, which keeps a second scene on the device. NULL is the
// renderer's, unless it is a reconstruction's. `gradients` is written only on success.
zs_status zs_render_backward(const struct zs_renderer *renderer,
                             const struct zs_scene *scene,
                             const struct zs_camera *cameras,
                             const struct zs_grad_outputs *grad_outputs,
                             size_t count,
                             const struct zs_render_options *options,
                             const struct zs_gradients *gradients);

/******************************************************************************/
/*  Features: values of any number of channels, held by Gaussians or tokens.  */
/******************************************************************************/

// Lifts pixel values of `count` cameras, in the scene's world, to features: means over all pixels,
// weighted by the blending weights of `group` consecutive Gaussians, such as 1 or those of a
// token. `group` divides their number N.
//
// `features` gets N / group x channels values, 0 for rows that no pixel shows; `weights`, unless
// NULL, N / group sums of blending weights in pixels. Both are written only on success.
zs_status zs_lift_features(const struct zs_renderer *renderer,
                           const struct zs_scene *scene,
                           const struct zs_camera *cameras,
                           const struct zs_pixel_values *values,
                           size_t count,
                           size_t channels,
                           size_t group,
                           float *features,
                           float *weights);

// Draws features, N / group x channels values as of zs_lift_features, as pictures of `count`
// cameras: height x width x channels blended values each, one after the other, 0 where nothing is.
// `pictures` is written only on success.
zs_status zs_render_features(const struct zs_renderer *renderer,
                             const struct zs_scene *scene,
                             const float *features,
                             size_t channels,
                             size_t group,
                             const struct zs_camera *cameras,
                             size_t count,
                             float *pictures);

/*************************************/
/*  The caller's own Vulkan device.  */
/*************************************/

// Kind of a zs_vulkan_requirement.
ZS_ENUM(zs_requirement_kind) {
    // `name` is the minimum API version, as "1.3", of VkApplicationInfo and the device.
    ZS_REQUIRES_API_VERSION = 0,
    // `name` is a device extension.
    ZS_REQUIRES_DEVICE_EXTENSION = 1,
    // `name` is a field of `structure` to set to VK_TRUE at device creation.
    ZS_REQUIRES_FEATURE = 2,
};

// A requirement for the caller's device.
typedef struct zs_vulkan_requirement {
    // Kind.
    zs_requirement_kind kind;
    // 1 if only faster precisions need it. Enable all that the device supports, then set
    // zs_vulkan_device.optional_features_enabled.
    uint32_t optional;
    // Vulkan's name; static.
    const char *name;
    // Static; "" unless a feature.
    const char *structure;
} zs_vulkan_requirement;

// vkGetInstanceProcAddr, cast to a function without arguments.
typedef void (*zs_vulkan_function)(void);

// Locks or unlocks a queue. Must not call this library.
typedef void (*zs_queue_lock)(void *user_data);

// Borrowed Vulkan handles, never destroyed.
typedef struct zs_vulkan_device {
    uint32_t struct_size;
    // Family of `queue`, with compute support.
    uint32_t queue_family;
    // vkGetInstanceProcAddr; NULL uses the system's loader.
    zs_vulkan_function get_instance_proc_addr;
    // VkInstance.
    void *instance;
    // VkPhysicalDevice.
    void *physical_device;
    // VkDevice.
    void *device;
    // VkQueue. Submissions happen only on calling threads.
    void *queue;
    // Called before each submission to `queue`, and `unlock_queue` right after it, on the same
    // thread. Do not hold the lock when calling the library. NULL if the queue is not shared.
    zs_queue_lock lock_queue;
    // NULL exactly if `lock_queue` is.
    zs_queue_lock unlock_queue;
    // Argument of both callbacks.
    void *user_data;
    // 1 if every supported optional requirement is enabled. 0 allows only ZS_PRECISION_FP32.
    uint32_t optional_features_enabled;
    uint32_t reserved;
    // As zs_device_options.cache_dir.
    const char *cache_dir;
} zs_vulkan_device;

// A value of a caller's timeline semaphore.
typedef struct zs_semaphore_point {
    // Timeline VkSemaphore, cast to uint64_t.
    uint64_t semaphore;
    // Value to wait for or to signal.
    uint64_t value;
} zs_semaphore_point;

// A caller's image or buffer as a copy destination. Handles are cast to uint64_t and must outlive
// the signals or, without signals, the renderer.
typedef struct zs_vulkan_target {
    uint32_t struct_size;
    uint32_t reserved;
    // VkImage with VK_IMAGE_USAGE_TRANSFER_DST_BIT, one sample and the zs_pixel_format's format,
    // owned by the queue's family or shared. 0 for a buffer.
    uint64_t image;
    // First column; the camera's size must fit from there.
    uint32_t x;
    // First row.
    uint32_t y;
    // Mip level.
    uint32_t mip_level;
    // Array layer.
    uint32_t array_layer;
    // VkImageLayout after the waits.
    int32_t old_layout;
    // VkImageLayout at the signals; 0 is VK_IMAGE_LAYOUT_SHADER_READ_ONLY_OPTIMAL.
    int32_t new_layout;
    // VkBuffer with VK_BUFFER_USAGE_TRANSFER_DST_BIT and contiguous rows; 0 for an image.
    uint64_t buffer;
    // First byte, a multiple of 4.
    uint64_t buffer_offset;
    // Writable bytes from there.
    uint64_t buffer_size;
    // Number of `waits`.
    size_t wait_count;
    // Number of `signals`.
    size_t signal_count;
    // Waited for before writing.
    const struct zs_semaphore_point *waits;
    // Signaled when the picture is written and visible.
    const struct zs_semaphore_point *signals;
} zs_vulkan_target;

// Lists the requirements of zs_device_from_vulkan.
zs_status zs_vulkan_requirements(const struct zs_vulkan_requirement **list, size_t *count);

// Adopts the caller's device. All required features must be enabled; this cannot be checked.
zs_status zs_device_from_vulkan(const struct zs_vulkan_device *vulkan, struct zs_device **device);

// Draws one camera into an image or buffer without a host copy, as ZS_PIXEL_RGBA8, BGRA8 or
// RGBA_F32. The renderer's device must be adopted.
//
// Returns when the scene is drawn and the copy is submitted. The copy starts after the waits and
// ends with the signals; without semaphores, queue order applies. The renderer's next picture may
// wait for this copy, so no wait may depend on it.
zs_status zs_render_to_vulkan(const struct zs_renderer *renderer,
                              const struct zs_camera *camera,
                              const struct zs_vulkan_target *target,
                              const struct zs_render_options *options);

#undef ZS_ENUM

#ifdef __cplusplus
}
#endif

#endif // ZIPSPLAT_H
