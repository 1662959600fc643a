/* Estimates depth and cameras of unposed photos with Depth Anything 3:
 *     cc depth.c $(pkg-config --cflags --libs zipsplat) -o depth
 *     ./depth MODEL PREFIX PHOTO...      MODEL: a released model.safetensors, or seeded:da3-small
 * Writes depths PREFIX0.pfm, ... and PREFIXcameras.txt, as refine.c reads it. */
#include <stdio.h>
#include <stdlib.h>
#include <zipsplat.h>

#define CHECK(call)                                                                \
    do {                                                                           \
        zs_status status_ = (call);                                                \
        if (status_ != ZS_OK) {                                                    \
            fprintf(stderr, "%s: %s\n", zs_status_name(status_), zs_last_error()); \
            goto done;                                                             \
        }                                                                          \
    } while (0)

enum { MAX_PHOTOS = 192, MAX_PATH = 4096 };

static FILE *create(const char *prefix, const char *name) {
    char path[MAX_PATH];
    snprintf(path, sizeof path, "%s%s", prefix, name);
    FILE *file = fopen(path, "wb");
    if (!file) perror(path);
    return file;
}

/* A portable float map: rows bottom-up; scale -1 means little-endian. */
static int save_depth(const char *prefix, size_t index, const zs_depth_map *view) {
    char name[32];
    snprintf(name, sizeof name, "%zu.pfm", index);
    FILE *file = create(prefix, name);
    if (!file) return 0;
    fprintf(file, "Pf\n%u %u\n-1\n", view->width, view->height);
    for (uint32_t y = view->height; y-- > 0;) {
        fwrite(view->depth + (size_t)y * view->width, sizeof *view->depth, view->width, file);
    }
    return !fclose(file);
}

static void save_camera(FILE *file, const zs_camera *camera) {
    fprintf(file, "%.17g %.17g %.17g %.17g", camera->fx, camera->fy, camera->cx, camera->cy);
    for (int k = 0; k < 9; k++) fprintf(file, " %.17g", camera->rotation[k]);
    for (int k = 0; k < 3; k++) fprintf(file, " %.17g", camera->translation[k]);
    fprintf(file, "\n");
}

int main(int argc, char **argv) {
    if (argc < 4 || argc - 3 > MAX_PHOTOS) {
        fprintf(stderr, "usage: %s MODEL PREFIX PHOTO... (at most %d)\n", argv[0], MAX_PHOTOS);
        return 2;
    }
    int result = EXIT_FAILURE;
    const size_t count = (size_t)argc - 3;
    zs_device *device = NULL;
    zs_depth_model *model = NULL;
    zs_depth_result *depths = NULL;
    zs_image_buffer *photos[MAX_PHOTOS] = {NULL};
    zs_image images[MAX_PHOTOS];
    FILE *cameras = NULL;

    CHECK(zs_device_create(NULL, &device));
    CHECK(zs_depth_model_load(device, argv[1], NULL, &model));
    for (size_t i = 0; i < count; i++) {
        images[i] = ZS_INIT(zs_image);
        CHECK(zs_image_buffer_open(argv[3 + i], &photos[i]));
        CHECK(zs_image_buffer_get_image(photos[i], &images[i]));
    }
    CHECK(zs_depth_predict(model, images, count, NULL, &depths));
    if (!(cameras = create(argv[2], "cameras.txt"))) goto done;
    for (size_t i = 0; i < count; i++) {
        zs_depth_map view = ZS_INIT(zs_depth_map);
        const zs_camera none = ZS_INIT(zs_camera);
        CHECK(zs_depth_result_get_map(depths, i, &view));
        const size_t middle = (size_t)view.height / 2 * view.width + view.width / 2;
        printf("%s: %ux%u, depth %g in the middle", argv[3 + i], view.width, view.height, view.depth[middle]);
        if (view.confidence) printf(", confidence %g", view.confidence[middle]);
        printf(view.camera ? "\n" : ", no camera\n");
        save_camera(cameras, view.image_camera ? view.image_camera : &none);
        if (!save_depth(argv[2], i, &view)) goto done;
    }
    result = EXIT_SUCCESS;

done:
    for (size_t i = 0; i < count; i++) zs_image_buffer_destroy(photos[i]);
    zs_depth_result_destroy(depths);
    zs_depth_model_destroy(model);
    zs_device_destroy(device);
    if (cameras && fclose(cameras)) result = EXIT_FAILURE;
    return result;
}
