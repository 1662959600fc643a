/* Reconstructs a scene from unposed photos and writes its cameras, as refine.c reads them:
 *     cc cameras.c $(pkg-config --cflags --libs zipsplat) -o cameras
 *     ./cameras MODEL scene.ply cameras.txt PHOTO...
 * MODEL: builtin, a checkpoint, or seeded:vits */
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

enum { MAX_PHOTOS = 192 };

int main(int argc, char **argv) {
    if (argc < 5 || argc - 4 > MAX_PHOTOS) {
        fprintf(stderr, "usage: %s MODEL scene.ply cameras.txt PHOTO... (at most %d)\n", argv[0], MAX_PHOTOS);
        return 2;
    }
    int result = EXIT_FAILURE;
    const size_t count = (size_t)argc - 4;
    zs_device *device = NULL;
    zs_model *model = NULL;
    zs_reconstruction *reconstruction = NULL;
    zs_scene *scene = NULL;
    zs_image_buffer *photos[MAX_PHOTOS] = {NULL};
    zs_image images[MAX_PHOTOS];
    FILE *file = NULL;

    CHECK(zs_device_create(NULL, &device));
    CHECK(zs_model_load(device, argv[1], NULL, &model));
    for (size_t i = 0; i < count; i++) {
        images[i] = ZS_INIT(zs_image);
        CHECK(zs_image_buffer_open(argv[4 + i], &photos[i]));
        CHECK(zs_image_buffer_get_image(photos[i], &images[i]));
    }
    CHECK(zs_reconstruct(model, images, count, NULL, &reconstruction));
    CHECK(zs_reconstruction_to_scene(reconstruction, &scene));
    CHECK(zs_scene_save(scene, argv[2], NULL));
    if (!(file = fopen(argv[3], "w"))) {
        perror(argv[3]);
        goto done;
    }
    for (size_t i = 0; i < count; i++) {
        zs_camera_estimate found = ZS_INIT(zs_camera_estimate);
        CHECK(zs_reconstruction_estimate_camera(reconstruction, i, &found));
        const zs_camera none = ZS_INIT(zs_camera), *camera = found.camera ? found.camera : &none;
        printf("%s: %u of %u patches agree%s\n", argv[4 + i], found.inliers, found.patches, found.camera ? "" : ": no camera");
        fprintf(file, "%.17g %.17g %.17g %.17g", camera->fx, camera->fy, camera->cx, camera->cy);
        for (int k = 0; k < 9; k++) fprintf(file, " %.17g", camera->rotation[k]);
        for (int k = 0; k < 3; k++) fprintf(file, " %.17g", camera->translation[k]);
        fprintf(file, "\n");
    }
    result = EXIT_SUCCESS;

done:
    for (size_t i = 0; i < count; i++) zs_image_buffer_destroy(photos[i]);
    zs_scene_destroy(scene);
    zs_reconstruction_destroy(reconstruction);
    zs_model_destroy(model);
    zs_device_destroy(device);
    if (file && fclose(file)) result = EXIT_FAILURE;
    return result;
}
