/* Reconstructs a scene from photos and draws a picture of it:
 *     cc reconstruct.c $(pkg-config --cflags --libs zipsplat) -o reconstruct
 *     ./reconstruct MODEL scene.ply picture.png PHOTO...
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

enum { SIDE = 256, MAX_PHOTOS = 192 };

static zs_progress_action show(void *user_data, const zs_progress *progress) {
    (void)user_data;
    fprintf(stderr, "%3.0f %% %s\n", 100 * progress->fraction, progress->stage);
    return ZS_CONTINUE; /* ZS_CANCEL cancels */
}

int main(int argc, char **argv) {
    if (argc < 5 || argc - 4 > MAX_PHOTOS) {
        fprintf(stderr, "usage: %s MODEL scene.ply picture.png PHOTO... (at most %d)\n", argv[0], MAX_PHOTOS);
        return 2;
    }
    int result = EXIT_FAILURE;
    const size_t count = (size_t)argc - 4;
    zs_device *device = NULL;
    zs_model *model = NULL;
    zs_reconstruction *reconstruction = NULL;
    zs_scene *scene = NULL;
    zs_renderer *renderer = NULL;
    zs_image_buffer *photos[MAX_PHOTOS] = {NULL};
    zs_image images[MAX_PHOTOS];
    unsigned char *pixels = malloc(4 * SIDE * SIDE);

    CHECK(zs_device_create(NULL, &device));
    CHECK(zs_model_load(device, argv[1], NULL, &model));
    for (size_t i = 0; i < count; i++) {
        images[i] = ZS_INIT(zs_image);
        CHECK(zs_image_buffer_open(argv[4 + i], &photos[i]));
        CHECK(zs_image_buffer_get_image(photos[i], &images[i]));
    }
    zs_reconstruct_options options = ZS_INIT(zs_reconstruct_options);
    options.progress = show;
    CHECK(zs_reconstruct(model, images, count, &options, &reconstruction));
    CHECK(zs_reconstruction_to_scene(reconstruction, &scene));
    CHECK(zs_scene_save(scene, argv[2], NULL));

    /* At the first photo's camera, the world's origin, with a field of view of 60 degrees. */
    zs_camera camera = {.struct_size = sizeof camera, .width = SIDE, .height = SIDE, .rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1}};
    camera.fx = camera.fy = 0.866 * SIDE, camera.cx = camera.cy = 0.5 * SIDE;
    zs_render_buffers picture = ZS_INIT(zs_render_buffers);
    picture.pixels = pixels;
    CHECK(zs_renderer_create(device, NULL, &renderer));
    CHECK(zs_renderer_set_reconstruction(renderer, reconstruction)); /* without a copy to the host */
    CHECK(zs_render(renderer, &camera, &picture, 1, NULL));
    zs_image drawn = {sizeof drawn, ZS_PIXEL_RGBA8, SIDE, SIDE, 0, pixels, NULL, 0, NULL};
    CHECK(zs_image_save_png(&drawn, argv[3]));
    result = EXIT_SUCCESS;

done:
    for (size_t i = 0; i < count; i++) {
        zs_image_buffer_destroy(photos[i]);
    }
    zs_renderer_destroy(renderer);
    zs_scene_destroy(scene);
    zs_reconstruction_destroy(reconstruction);
    zs_model_destroy(model);
    zs_device_destroy(device);
    free(pixels);
    return result;
}
