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
