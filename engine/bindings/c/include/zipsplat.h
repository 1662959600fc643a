/*
 * zipsplat.h: photos without poses to a compact scene of 3D Gaussians, and pictures of it, on Vulkan.
 *
 * Generated from engine/bindings/c/src. Copyright and licence: see LICENSE (Apache-2.0).
 *
 *     zs_context    a device at work; creates
 *     zs_model      a network with its weights on the device; makes
 *     zs_scene      Gaussians in host memory, from a model, a file or your arrays; zs_refine makes them sharp; is drawn by
 *     zs_renderer   a scene on the device; zs_render_backward gives gradients of its pictures
 *     zs_photo      a photo from a file or its bytes, for those who have no pixels yet
 *     zs_capture    the cameras of photos, as a transforms.json or COLMAP has them
 *     zs_bytes      a scene's file in memory
 *
 * Calls. Every function that can fail returns a zs_status: ZS_OK is 0, everything else a failure, whose message
 * zs_last_error has for the thread that called. A call that fails leaves nothing half made; one that creates an object sets
 * the pointer to NULL first. No C++ exception and no Rust panic leaves a function, and none ends the process, except where the
 * host has no memory left at all.
 *
 * Ownership. What a zs_..._create, _open, _adopt, _from_memory, _to_memory, zs_reconstruct or zs_refine hands out is yours; give
 * it back to its zs_..._destroy, once, on any thread, when no call uses it any more. Destroying NULL does nothing. Objects keep alive
 * what they are made from, so the order of destruction is free; only Vulkan handles of your own must outlive every object on
 * them. Pointers that you pass are read, or written, during the call only, unless their description says more. Pointers that you
 * get from functions returning const char * are never yours to free.
 *
 * Threads. Different objects may be used at the same time; so may one zs_context, zs_model or zs_scene. Calls on one
 * zs_renderer wait for each other. Callbacks run on the thread that made the call. Photos, weights and files are prepared by a
 * pool of threads, as many as there are cores or RAYON_NUM_THREADS says, which starts when it is first needed and ends with
 * the process; none of them calls you or touches your queue.
 *
 * Files. Besides the paths that you pass, a library keeps small ones in a folder of the user's: what the test of a device's
 * fast kernels found, and which tiles `zipsplat tune` found fastest. The folder is ZIPSPLAT_CACHE, or `zipsplat` in
 * XDG_CACHE_HOME or LOCALAPPDATA, or .cache/zipsplat in HOME, the first of these environment variables that is set. Where none
 * is, or nothing can be written, the test runs again in every process that needs it. Devices of yours (zs_context_adopt) and
 * ZS_PRECISION_EXACT need none of it.
 *
 * Structures that begin with struct_size may grow at their end in later versions. Where there is a ..._default function call
 * it, then set what you want to be different; otherwise set all fields to 0, then struct_size to the sizeof, in every element
 * of an array. A library takes the structures of its own version and of all earlier ones of the same ZS_ABI_VERSION, and
 * refuses larger ones. All others never change.
 *
 * Numbers in structures that stand for something (int32_t of an enumeration) are checked; one that is not known is refused.
 * Sizes are in bytes, counts in elements, lengths of pictures in pixels.
 *
 * World. Axes are x right, y down, z forward. That of a scene from photos is the first photo's camera. Where cameras are
 * given their unit is kept. Where none are, the scale is not metric: the network is trained to put what the photos see at a
 * median distance of about 1 from the first of them. That of a scene from a file or from arrays is its own.
 *
 * Bits. The same call with the same inputs gives the same bits on the same device and driver, whatever else runs.
 */

#ifndef ZIPSPLAT_H
#define ZIPSPLAT_H

#include <stddef.h>
#include <stdint.h>

// An enumeration of 32 bits: a type of its own in C++ and C23, a number in older C.
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
#define ZS_ENUM(name) enum name : int32_t; typedef enum name name; enum name : int32_t
#else
#define ZS_ENUM(name) typedef int32_t name; enum name
#endif

#ifdef __cplusplus
extern "C" {
#endif

/************************************************************************/
/*  The version that the header was made for, and that of the library.  */
/************************************************************************/

// Version of the library that this header belongs to. Fixes of bugs raise the last number, additions the middle one.
#define ZS_VERSION_MAJOR 0

// See ZS_VERSION_MAJOR.
#define ZS_VERSION_MINOR 1

// See ZS_VERSION_MAJOR.
#define ZS_VERSION_PATCH 0

// Version of the ABI. It rises when something here changes its meaning, size or place, and the shared library's file name
// with it; additions keep it.
#define ZS_ABI_VERSION 1

// The ABI version of the library that is loaded. Where it is not ZS_ABI_VERSION, call nothing else.
uint32_t zs_abi_version(void);

// The version of the library that is loaded, as "0.1.0". Static: never free it.
const char *zs_version(void);

/****************************************************************************/
/*  The ends of calls: a status, and a message for the thread that called.  */
/****************************************************************************/

// The end of a call. Numbers are never given a new meaning; later versions may add some, so treat one that you do not know
// as a failure.
ZS_ENUM(zs_status) {
    // The call did what it says.
    ZS_OK = 0,
    // A value you gave cannot be used: give another. The message names it, what was found and what is expected.
    ZS_ERROR_ARGUMENT = 1,
    // A file could not be opened, read or written.
    ZS_ERROR_IO = 2,
    // A file's or buffer's bytes are not what its format allows.
    ZS_ERROR_FORMAT = 3,
    // A checkpoint's tensors are not those of its network.
    ZS_ERROR_WEIGHTS = 4,
    // No Vulkan loader, no driver, or none whose device can run this. The message says what is missing.
    ZS_ERROR_NO_DEVICE = 5,
    // The device or the host has too little memory. Nothing was submitted; the message has the bytes.
    ZS_ERROR_OUT_OF_MEMORY = 6,
    // The driver refused a call that should have worked, or the validation layer had something to say.
    ZS_ERROR_DRIVER = 7,
    // The device is lost: it was reset or removed. Destroy everything that belongs to its context and create a new one;
    // scenes are in host memory and survive.
    ZS_ERROR_DEVICE_LOST = 8,
    // Your progress callback asked to stop.
    ZS_ERROR_CANCELLED = 9,
    // The build of the library does not have what was asked for.
    ZS_ERROR_UNSUPPORTED = 10,
    // A bug in the library. It goes on working, but the objects of this call are better destroyed.
    ZS_ERROR_INTERNAL = 11,
};

// A status's name as it is written here, "unknown status" for a number that is none. Static: never free it.
const char *zs_status_name(int32_t status);

// The failure of the last call of this thread that failed, in one sentence of UTF-8 for a log or a developer; "" when
// none has failed. A thread has one place for its message, the same until the thread ends: the pointer stays good, and the next
// call of this thread that fails writes its message there. So a call and its message may stand in one expression, whichever
// is evaluated first: printf("%s: %s", zs_status_name(zs_scene_open(path, &scene)), zs_last_error()). A message of more than
// 16 KiB is cut. Copy one that you want to keep.
const char *zs_last_error(void);

/***************************/
/*  Devices and contexts.  */
/***************************/

// Kinds of devices.
ZS_ENUM(zs_device_kind) {
    // Integrated in the processor, virtual, or unknown.
    ZS_DEVICE_OTHER = 0,
    // A graphics card.
    ZS_DEVICE_DISCRETE = 1,
    // The processor itself, by way of lavapipe.
    ZS_DEVICE_CPU = 2,
};

// A Vulkan device at work: everything that runs on it is created from a context. Any number of threads may use a context at
// the same time. Models and renderers keep what they need of it: it may be destroyed before them.
typedef struct zs_context zs_context;

// A device. Strings are UTF-8, end with NUL and are cut where they are too long.
typedef struct zs_device_info {
    // sizeof(zs_device_info); set it before the call.
    uint32_t struct_size;
    // Number of the device, as zs_context_options.device takes it; 0 for an adopted device.
    uint32_t index;
    // 1 where the engine can use the device, else 0.
    uint32_t usable;
    // Kind of the device.
    zs_device_kind kind;
    // Bytes of the memory that kernels work in.
    uint64_t memory_bytes;
    // The device's name.
    char name[256];
    // The driver's name and version.
    char driver[256];
    // Reasons why the device is not usable; "" where it is.
    char missing[512];
    // UUID of the device, 32 hexadecimal digits: those that CUDA and nvidia-smi have for it.
    char uuid[40];
} zs_device_info;

// Options of opening a device.
typedef struct zs_context_options {
    // sizeof(zs_context_options); zs_context_options_default sets it.
    uint32_t struct_size;
    // 1 to run under the Khronos validation layer with synchronisation validation, whose messages make calls fail with
    // ZS_ERROR_DRIVER: for development. Default 0, or 1 where the environment variable ZIPSPLAT_VALIDATION is 1.
    uint32_t validation;
    // Uses at most so many bytes of the device's memory and leaves the rest to others: what needs more fails with
    // ZS_ERROR_OUT_OF_MEMORY before anything runs. Default 0: all that there is.
    uint64_t max_memory_bytes;
    // A device's number ("0"; digits are nothing else), a part of its name ("nvidia"), or its
    // UUID, with or without GPU- and hyphens; NULL for the best. Default NULL.
    const char *device;
} zs_context_options;

// Counts the Vulkan devices of this machine, usable or not. ZS_ERROR_NO_DEVICE where there is no Vulkan loader or no
// driver.
zs_status zs_device_count(uint32_t *count);

// Says what device number `index` is, from 0 to below zs_device_count.
zs_status zs_device_get(uint32_t index, struct zs_device_info *info);

// Fills `options` with the defaults. `size` is sizeof(zs_context_options).
zs_status zs_context_options_default(struct zs_context_options *options, size_t size);

// Opens a device of its own: instance, device and queue are the context's. `options` may be NULL.
zs_status zs_context_create(const struct zs_context_options *options, struct zs_context **context);

// Says what device a context is on.
zs_status zs_context_get_info(const struct zs_context *context, struct zs_device_info *info);

// Destroys a context. Its device closes when its last model and renderer are gone too. NULL is allowed.
void zs_context_destroy(struct zs_context *context);

/*************************/
/*  Pixels and cameras.  */
/*************************/

// Layouts of a pixel in memory. Colour is that of ordinary pictures (sRGB-encoded), red, green and blue from 0 to 1 or 255.
ZS_ENUM(zs_pixel_format) {
    // 3 bytes: red, green, blue.
    ZS_PIXEL_RGB8 = 1,
    // 4 bytes: red, green, blue, alpha. VK_FORMAT_R8G8B8A8_UNORM.
    ZS_PIXEL_RGBA8 = 2,
    // 4 bytes: blue, green, red, alpha. VK_FORMAT_B8G8R8A8_UNORM.
    ZS_PIXEL_BGRA8 = 3,
    // 3 f32: red, green, blue.
    ZS_PIXEL_RGB_F32 = 4,
    // 4 f32: red, green, blue, alpha. VK_FORMAT_R32G32B32A32_SFLOAT.
    ZS_PIXEL_RGBA_F32 = 5,
};

// A photo in your memory, read during the call only. Its first row is the top one. Alpha is ignored; f32 values are clamped
// to 0..1 and rounded to 8 bits, which is what networks are trained with.
typedef struct zs_image {
    // sizeof(zs_image); set it before the call.
    uint32_t struct_size;
    // Layout of a pixel in memory.
    zs_pixel_format format;
    // Pixels a row, 1 to 32768.
    uint32_t width;
    // Rows, 1 to 32768.
    uint32_t height;
    // Bytes from a row to the one below it; negative where the picture is stored bottom-up; 0 where row follows row.
    int64_t stride;
    // The first pixel of the top row; of any alignment.
    const void *pixels;
} zs_image;

// A pinhole camera. Axes are OpenCV's: x right, y down, z forward. Pixel centres are at +0.5: the top left corner of a
// picture is (0, 0), so the principal point of a centred lens is (width / 2, height / 2).
typedef struct zs_camera {
    // sizeof(zs_camera); set it before the call.
    uint32_t struct_size;
    // Must be 0.
    uint32_t reserved;
    // Pixels a row.
    uint32_t width;
    // Rows.
    uint32_t height;
    // Horizontal focal length in pixels.
    double fx;
    // Vertical focal length in pixels.
    double fy;
    // Principal point from the left edge, in pixels.
    double cx;
    // Principal point from the top edge, in pixels.
    double cy;
    // Camera-to-world rotation, row by row: its columns are the camera's right, down and forward in the world.
    double rotation[9];
    // The camera's centre in the world.
    double translation[3];
} zs_camera;

/*********************************************************/
/*  Photos from files and bytes, and pictures to files.  */
/*********************************************************/

// A photo, decoded, in host memory. It never changes, so any number of threads may use it at the same time.
typedef struct zs_photo zs_photo;

// Reads a PNG, JPEG or WebP, told apart by content. The EXIF orientation is applied, alpha is dropped, and of 16-bit samples
// the high byte is kept. Cameras of COLMAP, and of what is built on it, are of the pixels as stored, before that orientation: read
// photos with such cameras by zs_capture_open_photo. `path` is UTF-8.
zs_status zs_photo_open(const char *path,
                        struct zs_photo **photo);

// As zs_photo_open, with a file's contents: `size` bytes at `data`, which are not needed any more when this returns.
zs_status zs_photo_from_memory(const void *data, size_t size, struct zs_photo **photo);

// Fills `image` with where the photo's pixels are (ZS_PIXEL_RGB8), for zs_reconstruct or to read them: the photo's own
// memory, there until it is destroyed. Set its struct_size before the call.
zs_status zs_photo_get_image(const struct zs_photo *photo, struct zs_image *image);

// Destroys a photo. NULL is allowed.
void zs_photo_destroy(struct zs_photo *photo);

// Writes a picture in your memory as a PNG of 8 bits a channel, without alpha. The file appears whole or not at all; one of
// that name is replaced. `path` is UTF-8.
zs_status zs_image_save_png(const struct zs_image *image,
                            const char *path);

/**************************************************************/
/*  Captures: photos and their cameras, as a file says them.  */
/**************************************************************/

// The posed photos of a capture. It never changes, so any number of threads may use it at the same time.
typedef struct zs_capture zs_capture;

// Reads the cameras of photos: a transforms.json of instant-ngp or nerfstudio, a COLMAP model's folder, text or binary, or a
// folder that has one of these. Axes become OpenCV's; world and unit stay the file's. No photo is read but for its size, where
// the file does not have it. `path` is UTF-8.
zs_status zs_capture_open(const char *path,
                          struct zs_capture **capture);

// Says how many photos a capture has, and what was ignored or left out in reading it, a note a line. The text is the capture's
// own memory, there until it is destroyed. `notes` may be NULL.
zs_status zs_capture_get_count(const struct zs_capture *capture,
                               size_t *count,
                               const char **notes);

// Says what photo number `index` is: the camera that took it, where lens distortion is undone a pinhole camera; its name as the
// file writes it; and where it lies, NULL where it was not found. Texts are the capture's own memory, there until it is destroyed.
// Pointers for what is not wanted may be NULL. Set the camera's struct_size before the call.
zs_status zs_capture_get(const struct zs_capture *capture,
                         size_t index,
                         struct zs_camera *camera,
                         const char **name,
                         const char **path);

// Finds the number of the photo that lies at `path` (UTF-8) by its file name; where several have it, by the longest common end of
// the path. Where none has it, `index` gets the number of photos. ZS_ERROR_ARGUMENT where several match as well.
zs_status zs_capture_find(const struct zs_capture *capture,
                          const char *path,
                          size_t *index);

// Reads photo number `index` as its camera sees it: the pixels as they are stored, whatever the EXIF orientation says, and without
// the distortion of its lens. `path` (UTF-8) is where it lies, NULL where the capture says it does.
zs_status zs_capture_open_photo(const struct zs_capture *capture,
                                size_t index,
                                const char *path,
                                struct zs_photo **photo);

// Destroys a capture. NULL is allowed.
void zs_capture_destroy(struct zs_capture *capture);

/**************************************************************/
/*  Scenes: Gaussians in and out of arrays, files and bytes.  */
/**************************************************************/

// Bytes of the library's, such as a scene's file in memory. They never change.
typedef struct zs_bytes zs_bytes;

// 3D Gaussians in host memory. A scene never changes, so any number of threads may use it at the same time. It belongs to no
// context: it outlives devices, also lost ones. A renderer copies what it needs, so a scene may be destroyed before it.
typedef struct zs_scene zs_scene;

// Gaussians as arrays, one a property, each as long as it says.
typedef struct zs_gaussians {
    // sizeof(zs_gaussians); set it before the call.
    uint32_t struct_size;
    // Highest band of spherical harmonics, 0 to 3. There are K = (sh_degree + 1)^2 coefficients a Gaussian and channel.
    uint32_t sh_degree;
    // N, the number of Gaussians.
    uint64_t count;
    // N x 3 centres.
    const float *means;
    // N x 3 standard deviations along the Gaussian's own axes: linear, not logarithms; not negative.
    const float *scales;
    // N x 4 rotations as quaternions w, x, y, z; of any length but zero.
    const float *quats;
    // N opacities from 0 to 1.
    const float *opacities;
    // N x K x 3 coefficients of spherical harmonics for red, green, blue: those of 3D Gaussian Splatting's files. The basis is
    // real and orthonormal, band after band and from m = -l to l in each, negative where m is odd. It begins with 0.282095,
    // -0.488603 y, 0.488603 z, -0.488603 x, where (x, y, z) is the unit vector in the world from the camera to the Gaussian's
    // centre. Colour is 0.5 plus the sum of basis times coefficients, and not below 0.
    const float *sh_coeffs;
} zs_gaussians;

// Options of writing a scene.
typedef struct zs_save_options {
    // sizeof(zs_save_options); zs_save_options_default sets it.
    uint32_t struct_size;
    // Version of an SPZ: 3; 2 for older readers; 4, packed by zstd, for those that know only the newest. Default 3.
    uint32_t spz_version;
} zs_save_options;

// Fills `gaussians` with how large a scene is and where its arrays are: the scene's own memory, there until it is destroyed.
// Set its struct_size before the call.
zs_status zs_scene_get_gaussians(const struct zs_scene *scene,
                                 struct zs_gaussians *gaussians);

// Makes a scene of your arrays, which are copied. All of them must be there, and every value finite and in its range.
zs_status zs_scene_create(const struct zs_gaussians *gaussians, struct zs_scene **scene);

// Reads a scene file: PLY of 3D Gaussian Splatting, also packed (.compressed.ply), SPZ, .splat, glTF with KHR_gaussian_splatting
// (.gltf, .glb). Whatever axes the format has, the scene's are x right, y down, z forward. `path` is UTF-8.
zs_status zs_scene_open(const char *path,
                        struct zs_scene **scene);

// As zs_scene_open, which refuses a file with values that are NaN, infinite or out of range: here Gaussians with such values are
// left out, and `dropped` gets their number. `dropped` may be NULL.
zs_status zs_scene_open_dropping_invalid(const char *path,
                                         uint64_t *dropped,
                                         struct zs_scene **scene);

// As zs_scene_open, with a file's contents: `size` bytes at `data`, which are not needed any more when this returns. PLY, SPZ and
// .glb are told apart by their first bytes; `format` names one that they do not tell ("splat", "gltf"), and may be NULL. A
// glTF may name no other file. Where `dropped` is not NULL, Gaussians with values that are NaN, infinite or out of range are left
// out and it gets their number; where it is NULL, such a scene is refused.
zs_status zs_scene_from_memory(const void *data,
                               size_t size,
                               const char *format,
                               uint64_t *dropped,
                               struct zs_scene **scene);

// Fills `options` with the defaults. `size` is sizeof(zs_save_options).
zs_status zs_save_options_default(struct zs_save_options *options, size_t size);

// Writes a scene in the format of the path's extension: .ply, .spz, .splat, .gltf or .glb. The file appears whole or not at
// all; one of that name is replaced. `options` may be NULL. `path` is UTF-8.
zs_status zs_scene_save(const struct zs_scene *scene,
                        const char *path,
                        const struct zs_save_options *options);

// As zs_scene_save, to memory: what the file of `format` ("ply", "spz", "splat", "gltf" or "glb") would have is handed out
// as an object, which is yours to destroy. `options` may be NULL.
zs_status zs_scene_to_memory(const struct zs_scene *scene,
                             const char *format,
                             const struct zs_save_options *options,
                             struct zs_bytes **bytes);

// Says where bytes are and how many: the object's own memory, there until it is destroyed.
zs_status zs_bytes_get(const struct zs_bytes *bytes, const void **data, size_t *size);

// Finds the cameras of the photos of a scene that zs_reconstruct made of `count` photos without cameras, in the scene's world: from
// where the Gaussians of each of a photo's patches are. The photos are taken to share a field of view, which is found, too.
// `cameras` is an array of `count`, each with its struct_size set; each gets the camera of the whole photo. `inliers` gets the number
// of patches that agree with it and `patches` how many there were; both are arrays of `count` or NULL. A photo whose
// camera is not found has a camera of width 0 and no inliers; where none is found, that is an error.
zs_status zs_scene_cameras(const struct zs_scene *scene,
                           struct zs_camera *cameras,
                           uint32_t *inliers,
                           uint32_t *patches,
                           size_t count);

// Destroys bytes. NULL is allowed.
void zs_bytes_destroy(struct zs_bytes *bytes);

// Destroys a scene. NULL is allowed.
void zs_scene_destroy(struct zs_scene *scene);

/*************/
/*  Models.  */
/*************/

// Number formats of the network. Geometry is f32 always.
ZS_ENUM(zs_precision) {
    // ZS_PRECISION_FAST on a GPU with matrix units whose kernels passed their test, else ZS_PRECISION_EXACT.
    ZS_PRECISION_BEST = 0,
    // f32 throughout.
    ZS_PRECISION_EXACT = 1,
    // f16 factors of matrix products, all else f32. Refused where the device cannot, or fails the test.
    ZS_PRECISION_FAST = 2,
    // bf16 factors of matrix products, all else f32: f32's range in 8 bits. Refused as ZS_PRECISION_FAST.
    ZS_PRECISION_FAST_BF16 = 3,
    // 8-bit factors in the linear layers of blocks, all else as ZS_PRECISION_FAST.
    ZS_PRECISION_TURBO = 4,
};

// A network with its weights on a context's device. Any number of threads may reconstruct with a model at the same time.
typedef struct zs_model zs_model;

// Called now and then while something takes long, on the thread that made the call, with the share that is done (0 to 1) and
// what is under way (for a log; valid during the call). Return 0 to go on; anything else stops the work, which then ends
// with ZS_ERROR_CANCELLED. It must return: no longjmp, no C++ exception. It may call zs_ functions, but not with the objects
// of the call that it came from.
typedef int32_t (*zs_progress)(void *user_data, double fraction, const char *stage);

// Options of loading a model.
typedef struct zs_model_options {
    // sizeof(zs_model_options); zs_model_options_default sets it.
    uint32_t struct_size;
    // Number formats. Default ZS_PRECISION_BEST.
    zs_precision precision;
    // The network of a checkpoint that does not say: "vitg", "vits", "vitb", "vitl", "da3s", "da3b" or "da3l", and what else it
    // leaves open, as in "vits:out_layers=5,7,11:alt_start=5:rope_start=5". NULL takes what the file says.
    // Default NULL.
    const char *variant;
    // Told how far it is; may stop it. Default NULL.
    zs_progress progress;
    // Given to `progress`.
    void *user_data;
    // 1 to be able to refine the tokens of its scenes with ZS_REFINE_TOKENS: the network's head stays on the device in f32 besides, and
    // each scene keeps its tokens there until it is destroyed. Default 0.
    uint32_t tokens;
    // 0.
    uint32_t reserved;
} zs_model_options;

// Facts about a model.
typedef struct zs_model_info {
    // sizeof(zs_model_info); set it before the call.
    uint32_t struct_size;
    // Side in pixels of the square pictures that it is best with.
    uint32_t picture_side;
    // Side of a patch in pixels: sizes of pictures are multiples of it.
    uint32_t patch;
    // Gaussians that a token becomes. At ratio 1 there are width / patch * height / patch tokens a photo.
    uint32_t gaussians_per_token;
    // Highest band of spherical harmonics of its scenes.
    uint32_t sh_degree;
    // Number formats in use: a zs_precision other than ZS_PRECISION_BEST.
    zs_precision precision;
    // Bytes of its weights on the device.
    uint64_t weight_bytes;
    // Reasons why the model may be slow, one a line: GPUs that cannot be used, where a CPU is; kernels that failed the test before their
    // first use and are not used, and where that leaves too few, ZS_PRECISION_BEST is ZS_PRECISION_EXACT. "" where there is none.
    // Also what was rounded or assumed to read the weights. The model's own memory, there until it is destroyed.
    const char *notes;
} zs_model_info;

// Fills `options` with the defaults. `size` is sizeof(zs_model_options).
zs_status zs_model_options_default(struct zs_model_options *options, size_t size);

// Loads a checkpoint onto a context's device: safetensors or a PyTorch archive at `path` (UTF-8), the model that is built
// into the library for "embedded" (ZS_ERROR_UNSUPPORTED where none is), or random numbers for "seeded:VARIANT", to try things
// out. `options` may be NULL.
zs_status zs_model_open(const struct zs_context *context,
                        const char *path,
                        const struct zs_model_options *options,
                        struct zs_model **model);

// As zs_model_open, with a file's contents, which are not needed any more when this returns.
zs_status zs_model_from_memory(const struct zs_context *context,
                               const void *data,
                               size_t size,
                               const struct zs_model_options *options,
                               struct zs_model **model);

// Says what a model is.
zs_status zs_model_get_info(const struct zs_model *model, struct zs_model_info *info);

// Destroys a model. NULL is allowed.
void zs_model_destroy(struct zs_model *model);

/****************************************/
/*  Reconstruction: photos to a scene.  */
/****************************************/

// Share of the tokens that the paper keeps: 0.5 sqrt(2 / number of photos).
#define ZS_RATIO_AUTO 0.0

// The length that is found from the cameras and, where there is a capture, from its points.
#define ZS_UNIT_AUTO 0.0

// Ways to choose the tokens that are kept where the ratio is below 1.
ZS_ENUM(zs_selection) {
    // The nearest token of each centroid of k-means: the method's own.
    ZS_SELECT_KMEANS = 0,
    // Evenly spread.
    ZS_SELECT_STRIDE = 1,
    // Random, by `seed`.
    ZS_SELECT_RANDOM = 2,
};

// The world that a scene is in.
ZS_ENUM(zs_world) {
    // The first photo's camera: x right, y down, z forward.
    ZS_WORLD_FIRST_CAMERA = 0,
    // The world of `cameras`, which then fit the scene as they are.
    ZS_WORLD_CAMERAS = 1,
};

// Options of a reconstruction.
typedef struct zs_reconstruct_options {
    // sizeof(zs_reconstruct_options); zs_reconstruct_options_default sets it.
    uint32_t struct_size;
    // World of the scene; ZS_WORLD_CAMERAS needs `cameras`. Default ZS_WORLD_FIRST_CAMERA.
    zs_world world;
    // Share of the tokens that become Gaussians, above 0 and up to 1, or ZS_RATIO_AUTO. Fewer are faster and smaller.
    // Default 1.
    double ratio;
    // Length in the unit of `cameras`, and of the scene, that the network takes for 1. It is trained with what the photos see at
    // a median distance of about 1 from the first: with cameras in metres of a place 20 m away give 20, or ZS_UNIT_AUTO.
    // Default 1.
    double unit;
    // The way to choose the tokens that are kept. Default ZS_SELECT_KMEANS.
    zs_selection selection;
    // Width of what the network sees of each photo, a multiple of the model's patch: photos are cropped around their centre
    // to this shape and scaled to it. 0 for the model's own. Default 0.
    uint32_t width;
    // Height of it; 0 together with `width`. Default 0.
    uint32_t height;
    // Number of `cameras`: 0, or one for each photo. Default 0.
    uint32_t camera_count;
    // For ZS_SELECT_RANDOM: the same seed, the same choice. Default 0.
    uint64_t seed;
    // Cameras of the whole photos as you pass them, where they are known; the first one's becomes the world, or `world`
    // says otherwise. Their unit is kept; `unit` says how far away the scene is in it. Default NULL.
    const struct zs_camera *cameras;
    // Told how far it is; may stop it. Default NULL.
    zs_progress progress;
    // Given to `progress`.
    void *user_data;
    // The capture that `cameras` are of, for ZS_UNIT_AUTO: its points and all its cameras then say how far away the scene is; where
    // it is NULL, `cameras` do. Default NULL.
    const struct zs_capture *capture;
    // For many photos: attention across them sees the mean of `pool` x `pool` patches in place of each, 1 to 4. More are faster
    // and less exact. Default 1.
    uint64_t pool;
} zs_reconstruct_options;

// Fills `options` with the defaults. `size` is sizeof(zs_reconstruct_options).
zs_status zs_reconstruct_options_default(struct zs_reconstruct_options *options, size_t size);

// Reconstructs a scene from 1 to 192 photos of one place. It returns when the scene is there. The world is the first photo's
// camera, or what `options` says. `options` may be NULL.
zs_status zs_reconstruct(const struct zs_model *model,
                         const struct zs_image *images,
                         size_t image_count,
                         const struct zs_reconstruct_options *options,
                         struct zs_scene **scene);

/***********************************************************************************/
/*  Depth: photos to the depth of every pixel, and to the cameras that took them.  */
/***********************************************************************************/

// Sources of the cameras that a network finds.
ZS_ENUM(zs_cameras_from) {
    // The network's camera decoder.
    ZS_CAMERAS_FROM_DECODER = 0,
    // The rays of all pixels, principal point included. Photos whose rays agree on none have no camera.
    ZS_CAMERAS_FROM_RAYS = 1,
};

// A network of Depth Anything 3 with its weights on a context's device. Any number of threads may use it at the same time.
typedef struct zs_depth_model zs_depth_model;

// Depth of photos, and the cameras that took them, in host memory. It never changes, so any number of threads may use it at the same
// time.
typedef struct zs_depths zs_depths;

// Options of finding depth.
typedef struct zs_depth_options {
    // sizeof(zs_depth_options); zs_depth_options_default sets it.
    uint32_t struct_size;
    // Longer side of the photos as the network sees them, 14 to 8192 pixels: whole, each side the nearest multiple of 14. Of photos of
    // different shapes it sees the middle that all have. Default 504.
    uint32_t side;
    // Source of the cameras, where none are given. Default ZS_CAMERAS_FROM_DECODER.
    zs_cameras_from cameras_from;
    // 1 where photos of one size may have different focal lengths; 0 gives them one, the median, weighted by how confident the network
    // is of each photo's depth. Default 0.
    uint32_t own_focal_lengths;
    // Number of `cameras`: 0, or one for each photo. Default 0.
    uint32_t camera_count;
    // 0.
    uint32_t reserved;
    // Cameras of the whole photos as you pass them, where they are known, for networks that see all photos at once. Depth is then in
    // their unit, and they are the cameras that are found. Default NULL.
    const struct zs_camera *cameras;
    // Told how far it is; may stop it. Default NULL.
    zs_progress progress;
    // Given to `progress`.
    void *user_data;
} zs_depth_options;

// The depth of a photo, in the memory of its zs_depths, there until that is destroyed. Arrays are `[height][width]`.
typedef struct zs_depth_view {
    // sizeof(zs_depth_view); set it before the call.
    uint32_t struct_size;
    // 0.
    uint32_t reserved;
    // Pixels a row.
    uint32_t width;
    // Rows.
    uint32_t height;
    // Along the camera's axis, in one unit for all photos that were seen at once: that of the cameras.
    const float *depth;
    // From 1 on, where the network sees all photos at once; else NULL.
    const float *confidence;
    // From 0 on, above 0.3 sky, where the network sees each photo by itself; else NULL.
    const float *sky;
} zs_depth_view;

// Loads a network of Depth Anything 3 onto a context's device: a released file (model.safetensors) at `path` (UTF-8), or random numbers
// for "seeded:NAME", such as "seeded:da3-small". Of `options`, which may be NULL, `variant` has to be NULL and `tokens` 0.
zs_status zs_depth_model_open(const struct zs_context *context,
                              const char *path,
                              const struct zs_model_options *options,
                              struct zs_depth_model **model);

// Destroys a depth model. NULL is allowed.
void zs_depth_model_destroy(struct zs_depth_model *model);

// Fills `options` with the defaults. `size` is sizeof(zs_depth_options).
zs_status zs_depth_options_default(struct zs_depth_options *options, size_t size);

// Finds the depth of 1 to 192 photos of one place, and, with a network that sees all of them at once, the cameras that took them, in a
// world about one of them. It returns when all is there. `options` may be NULL.
zs_status zs_depth_find(const struct zs_depth_model *model,
                        const struct zs_image *images,
                        size_t image_count,
                        const struct zs_depth_options *options,
                        struct zs_depths **depths);

// Says what was found of photo number `index`: its depth, and the camera that took it, of the whole photo, in the world of all; of a photo
// whose camera nobody knows width and height are 0. Either may be NULL. Set their struct_size before the call.
zs_status zs_depths_get(const struct zs_depths *depths,
                        size_t index,
                        struct zs_depth_view *view,
                        struct zs_camera *camera);

// Makes a scene of the depth of photos with cameras: a Gaussian for each pixel that the network is confident of, in the world of the
// cameras; of each patch of 14 x 14 pixels at most `keep`, those that show most, or all for 0.
zs_status zs_depths_scene(const struct zs_depths *depths,
                          uint32_t keep,
                          struct zs_scene **scene);

// Destroys depths. NULL is allowed.
void zs_depths_destroy(struct zs_depths *depths);

/***************************************************/
/*  Refinement: a scene made to look like photos.  */
/***************************************************/

// One photo is held out where there are 9 or more, else none.
#define ZS_HOLD_OUT_AUTO -1

// The values that a refinement moves.
ZS_ENUM(zs_refine_what) {
    // The scene's Gaussians.
    ZS_REFINE_GAUSSIANS = 0,
    // The tokens of which the network's head makes its Gaussians: of a scene as zs_reconstruct made it, with a model that keeps them
    // (zs_model_options.tokens).
    ZS_REFINE_TOKENS = 1,
};

// Reasons why a refinement ended.
ZS_ENUM(zs_refine_end) {
    // All steps were taken.
    ZS_REFINE_FINISHED = 0,
    // Your progress callback asked to stop.
    ZS_REFINE_STOPPED = 1,
    // The loss grew, or became NaN or infinite.
    ZS_REFINE_DIVERGED = 2,
};

// Progress of a refinement. The library fills it, and later versions may add fields at its end.
typedef struct zs_refining {
    // Bytes of this structure in the library's version.
    uint32_t struct_size;
    // Steps that are done.
    uint32_t step;
    // All steps.
    uint32_t steps;
    // 0.
    uint32_t reserved;
    // Mean loss of the photos of the last step.
    double loss;
    // PSNR in dB of the held-out photos, when they were looked at last; NaN where none are held out.
    double psnr;
    // Seconds that are left, as steps took so far.
    double seconds_left;
} zs_refining;

// Called after each step, on the thread that made the call; `now` is valid during the callback. Return 0 to go on. Anything else
// ends the refinement early and is no failure: the best scene so far is handed out. It must return: no longjmp, no C++
// exception. It may call zs_ functions.
typedef int32_t (*zs_refine_progress)(void *user_data, const struct zs_refining *now);

// Options of a refinement.
typedef struct zs_refine_options {
    // sizeof(zs_refine_options); zs_refine_options_default sets it.
    uint32_t struct_size;
    // Steps of the optimiser. Default 100.
    uint32_t steps;
    // Photos of a step, at least 1; more than there are to learn from count as all. Default 4.
    uint32_t views_per_step;
    // Photos to hold out, evenly spread, fewer than there are, or ZS_HOLD_OUT_AUTO. Nothing is learnt from them: the scene that is
    // handed out is that of the step that predicts them best. Default ZS_HOLD_OUT_AUTO.
    int32_t hold_out;
    // Most pixels of a photo along x: a larger one is compared at the largest size that fits. 0 for photos as they are.
    // Default 1600.
    uint32_t width;
    // Most pixels along y; 0 together with `width`. Default 1600.
    uint32_t height;
    // Seed of the order of the photos: the same seed, the same scene. Default 0.
    uint64_t seed;
    // Told how far it is; may stop it. Default NULL.
    zs_refine_progress progress;
    // Given to `progress`.
    void *user_data;
    // The values that are moved. Default ZS_REFINE_GAUSSIANS.
    zs_refine_what what;
    // 0.
    uint32_t reserved;
} zs_refine_options;

// The outcome of a refinement.
typedef struct zs_refine_info {
    // sizeof(zs_refine_info); set it before the call.
    uint32_t struct_size;
    // The reason why the refinement ended.
    zs_refine_end ended;
    // Steps that were taken.
    uint32_t steps;
    // The step after which the scene was kept; 0 where none made it better.
    uint32_t best_step;
    // Mean loss of the photos of the first step, at the size of that step; NaN where there was
    // none.
    double first_loss;
    // Mean loss of the photos of the last step, at the size of that step; NaN where there was
    // none.
    double last_loss;
    // PSNR in dB of the held-out photos before the first step; NaN where none are held out.
    double psnr_before;
    // PSNR in dB of the held-out photos with the scene that was kept; NaN where none are held out.
    double psnr;
    // Seconds that it took.
    double seconds;
    // PSNR in dB of the training photos at full size before the first step: the mean of at most
    // 16, evenly spread.
    double training_psnr_before;
    // PSNR in dB of the same photos with the scene that was kept.
    double training_psnr;
} zs_refine_info;

// Fills `options` with the defaults. `size` is sizeof(zs_refine_options).
zs_status zs_refine_options_default(struct zs_refine_options *options, size_t size);

// Makes a scene sharp: moves its Gaussians, or the tokens that it was made of, until each of `count` photos is what the camera of its number sees, and hands out the
// result as a scene of its own. The scene may come from anywhere; `cameras` are those of the whole photos, in the scene's world.
// It returns when the refinement has ended: after all steps, when `progress` asked to stop, or when the loss grew. That is
// no failure: the scene is the best that there was. `options` may be NULL, and so may `info`, which is filled with what came
// of it.
zs_status zs_refine(const struct zs_context *context,
                    const struct zs_scene *scene,
                    const struct zs_image *images,
                    const struct zs_camera *cameras,
                    size_t count,
                    const struct zs_refine_options *options,
                    struct zs_refine_info *info,
                    struct zs_scene **refined);

/*********************************************************************/
/*  Renderers: a scene on a device, drawn into the caller's memory.  */
/*********************************************************************/

// Kinds of depth along the camera's z axis, in world units.
ZS_ENUM(zs_depth) {
    // The mean depth of what is seen: the sum of depth times blending weight, over alpha. 0 where nothing is.
    ZS_DEPTH_EXPECTED = 0,
    // The sum of depth times blending weight.
    ZS_DEPTH_ACCUMULATED = 1,
};

// A scene on a context's device, ready to be drawn. It keeps what it recorded for the last four sizes and kinds of picture:
// drawing the same kind again is fast. Threads that use one renderer at the same time wait for each other.
typedef struct zs_renderer zs_renderer;

// Options of drawing.
typedef struct zs_render_options {
    // sizeof(zs_render_options); zs_render_options_default sets it.
    uint32_t struct_size;
    // Format of the pixels that are written. 8-bit colour is clamped and truncated, as in the pictures of the reference, 8-bit alpha
    // is rounded, f32 values are neither. Where there is alpha it is what covers the background, and colour contains the
    // background's share: on black, the default, it is premultiplied. Default ZS_PIXEL_RGBA8.
    zs_pixel_format format;
    // Kind of depth that zs_picture.depth gets. Default ZS_DEPTH_EXPECTED.
    zs_depth depth;
    // 1 to make Gaussians thinner than a pixel fainter by as much as drawing widens them (Mip-Splatting): for scenes that
    // were made that way. Default 0.
    uint32_t antialiased;
    // Red, green and blue behind the scene. Default black.
    float background[3];
    // Near plane: the camera depth below which Gaussians are culled, in the scene's unit. 0, the
    // default, is 0.01, or less for scenes with an extent below 0.1.
    float near_plane;
} zs_render_options;

// Memory of a picture: yours for what you want of it, NULL for what you do not.
typedef struct zs_picture {
    // sizeof(zs_picture); set it before the call.
    uint32_t struct_size;
    // Must be 0.
    uint32_t reserved;
    // Bytes from a row of `pixels` to the one below it; negative to store the picture bottom-up; 0 for row after row. What
    // lies between rows is left as it is.
    int64_t stride;
    // The first pixel of the top row, in the format of the options; of any alignment.
    void *pixels;
    // height x width: alpha from 0 to 1.
    float *alpha;
    // height x width: depth in world units.
    float *depth;
} zs_picture;

// Brings a scene to a context's device. The scene may be destroyed afterwards.
zs_status zs_renderer_create(const struct zs_context *context,
                             const struct zs_scene *scene,
                             struct zs_renderer **renderer);

// Draws another scene from now on. Cheap for one of the same number of Gaussians and degree. After a failure draw nothing
// before another call of this has succeeded.
zs_status zs_renderer_set_scene(const struct zs_renderer *renderer,
                                const struct zs_scene *scene);

// Destroys a renderer, after waiting for pictures on their way to zs_vulkan_target. NULL is allowed.
void zs_renderer_destroy(struct zs_renderer *renderer);

// Fills `options` with the defaults. `size` is sizeof(zs_render_options).
zs_status zs_render_options_default(struct zs_render_options *options, size_t size);

// Draws `count` cameras, each into the picture of its number. It returns when all are written. Cameras of one size are drawn
// together. After a failure some pictures may be written. `options` may be NULL.
zs_status zs_render(const struct zs_renderer *renderer,
                    const struct zs_camera *cameras,
                    const struct zs_picture *pictures,
                    size_t count,
                    const struct zs_render_options *options);

/********************************************************************************************/
/*  Gradients: pictures' weights back to Gaussians and cameras, for an optimiser of yours.  */
/********************************************************************************************/

// Memory of gradients: yours for those that you want, NULL for the others. Every array is written, not added to.
typedef struct zs_gradients {
    // sizeof(zs_gradients); set it before the call.
    uint32_t struct_size;
    // Must be 0.
    uint32_t reserved;
    // N x 3 by the centres.
    float *means;
    // N x 3 by the standard deviations, which are linear.
    float *scales;
    // N x 4 by the rotations as you pass them, of any length.
    float *quats;
    // N by the opacities.
    float *opacities;
    // N x K x 3 by the coefficients.
    float *sh_coeffs;
    // count x 10 by the cameras: w x, y, z and v x, y, z, where the camera-to-world pose moves as pose o (exp(w^), v), R' = R exp(w^)
    // and t' = t + R v; then fx, fy, cx, cy.
    float *cameras;
} zs_gradients;

// Gives the gradients of the sum, over `count` cameras and all pixels, of what zs_render draws of `scene` times its weight. Weights
// are what `weights` points to, read and not written: of ZS_PIXEL_RGB_F32, which `options` must have, of alpha and of depth; NULL is 0.
// With the weights d loss / d pixel the gradients are those of the loss. Coefficients of bands that are 0 have gradients, too. The
// scene need not be the renderer's: the renderer keeps one more on the device, and what it recorded for the last four sizes
// and kinds. It returns when `gradients` is written; after a failure nothing is.
zs_status zs_render_backward(const struct zs_renderer *renderer,
                             const struct zs_scene *scene,
                             const struct zs_camera *cameras,
                             const struct zs_picture *weights,
                             size_t count,
                             const struct zs_render_options *options,
                             const struct zs_gradients *gradients);

/*****************************************************/
/*  An app's own Vulkan device, images and buffers.  */
/*****************************************************/

// Kinds of zs_vulkan_requirement.
ZS_ENUM(zs_requirement_kind) {
    // `name` is the least version for VkApplicationInfo.apiVersion and of the device, as "1.3".
    ZS_REQUIRES_API_VERSION = 0,
    // `name` is an extension of the device.
    ZS_REQUIRES_DEVICE_EXTENSION = 1,
    // `name` is a field to set to VK_TRUE of the structure `structure`, in the chain of VkDeviceCreateInfo.
    ZS_REQUIRES_FEATURE = 2,
};

// Something that has to be enabled on a device of yours.
typedef struct zs_vulkan_requirement {
    // Kind of the requirement.
    zs_requirement_kind kind;
    // 1 where only precisions other than exact need it: enable those that the device has, all of them, and say so in
    // zs_vulkan_device.fast.
    uint32_t optional;
    // Static: never free it.
    const char *name;
    // Static; "" but for a feature.
    const char *structure;
} zs_vulkan_requirement;

// vkGetInstanceProcAddr, cast to a function without arguments.
typedef void (*zs_vulkan_function)(void);

// Locks or unlocks a queue. It must return, and call nothing of this library.
typedef void (*zs_queue_lock)(void *user_data);

// Vulkan handles of yours. Every one is used and none is destroyed; nothing is enabled on them.
typedef struct zs_vulkan_device {
    // sizeof(zs_vulkan_device); zs_vulkan_device_default sets it.
    uint32_t struct_size;
    // Family of `queue`; it must be able to compute.
    uint32_t queue_family;
    // Your vkGetInstanceProcAddr; NULL for that of the system's loader. Default NULL.
    zs_vulkan_function get_instance_proc_addr;
    // VkInstance.
    void *instance;
    // VkPhysicalDevice.
    void *physical_device;
    // VkDevice.
    void *device;
    // VkQueue. The engine submits to it from the threads that call the engine, never from one of its own.
    void *queue;
    // Called before each submission to `queue`, on the thread that submits; `unlock_queue` right after it, and never is the
    // lock held while the engine waits. Do not hold the lock yourself when you call the engine. NULL where nobody else uses
    // the queue while a call runs. Default NULL.
    zs_queue_lock lock_queue;
    // Both or none.
    zs_queue_lock unlock_queue;
    // Given to both.
    void *user_data;
    // 1 where everything optional in zs_vulkan_requirements that the physical device has is enabled. Default 0, which leaves only
    // ZS_PRECISION_EXACT.
    uint32_t fast;
    // Must be 0.
    uint32_t reserved;
} zs_vulkan_device;

// A value of a timeline semaphore of yours.
typedef struct zs_semaphore_point {
    // VkSemaphore of type timeline, cast to uint64_t.
    uint64_t semaphore;
    // To wait for, or to signal.
    uint64_t value;
} zs_semaphore_point;

// An image or a buffer of yours that a picture is copied to on the device. Handles are cast to uint64_t. They must stay until
// the signals were given, or, without signals, until the renderer is destroyed.
typedef struct zs_vulkan_target {
    // sizeof(zs_vulkan_target); zs_vulkan_target_default sets it.
    uint32_t struct_size;
    // Must be 0.
    uint32_t reserved;
    // VkImage with usage VK_IMAGE_USAGE_TRANSFER_DST_BIT, one sample and the format that zs_pixel_format names, owned by the
    // queue's family or shared; 0 for a buffer. Default 0.
    uint64_t image;
    // First pixel that is written; the camera's width and height must fit behind it. Default 0.
    uint32_t x;
    // First row that is written. Default 0.
    uint32_t y;
    // Mip level. Default 0.
    uint32_t mip_level;
    // Array layer. Default 0.
    uint32_t array_layer;
    // VkImageLayout that level and layer are in when the waits are over. Default VK_IMAGE_LAYOUT_UNDEFINED, which may lose
    // what is there.
    int32_t old_layout;
    // VkImageLayout that they are in when the signals are given. Default VK_IMAGE_LAYOUT_SHADER_READ_ONLY_OPTIMAL.
    int32_t new_layout;
    // VkBuffer with usage VK_BUFFER_USAGE_TRANSFER_DST_BIT; 0 for an image. Rows follow each other. Default 0.
    uint64_t buffer;
    // First byte in the buffer, a multiple of 4. Default 0.
    uint64_t buffer_offset;
    // Bytes that may be written from there. Default 0.
    uint64_t buffer_size;
    // Number of `waits`. Default 0.
    uint32_t wait_count;
    // Number of `signals`. Default 0.
    uint32_t signal_count;
    // Points that have to be reached before the target is touched. Read during the call. Default NULL.
    const struct zs_semaphore_point *waits;
    // Given when the picture is in the target and visible to every later use. Read during the call. Default NULL.
    const struct zs_semaphore_point *signals;
} zs_vulkan_target;

// Lists what has to be enabled on a device of yours before zs_context_adopt, and what may be; nothing else is used. Needs no
// device. The list is static: never free it.
zs_status zs_vulkan_requirements(const struct zs_vulkan_requirement **list,
                                 size_t *count);

// Fills `device` with the defaults. `size` is sizeof(zs_vulkan_device).
zs_status zs_vulkan_device_default(struct zs_vulkan_device *device, size_t size);

// Makes a context of a device of yours, on which everything in zs_vulkan_requirements that is not optional is enabled: that cannot be checked.
// Destroy the context and all its models and renderers before the device.
zs_status zs_context_adopt(const struct zs_vulkan_device *device,
                           struct zs_context **context);

// Fills `target` with the defaults. `size` is sizeof(zs_vulkan_target).
zs_status zs_vulkan_target_default(struct zs_vulkan_target *target, size_t size);

// Draws one camera into an image or buffer of yours, without a copy by the host: ZS_PIXEL_RGBA8, BGRA8 or RGBA_F32. The
// renderer's context must be an adopted one. When this returns the scene is drawn and the copy to the target is submitted; it
// begins when the waits are over and ends with the signals. Without semaphores it is ordered as everything on one queue. The
// next picture of this renderer may wait for this copy, so do not make a wait depend on it. `options` may be NULL.
zs_status zs_render_to_vulkan(const struct zs_renderer *renderer,
                              const struct zs_camera *camera,
                              const struct zs_vulkan_target *target,
                              const struct zs_render_options *options);

#undef ZS_ENUM

#ifdef __cplusplus
}
#endif

#endif // ZIPSPLAT_H
