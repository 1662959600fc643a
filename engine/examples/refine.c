/* Refines a scene against photos with known cameras:
 *     cc refine.c $(pkg-config --cflags --libs zipsplat) -o refine
 *     ./refine scene.ply cameras.txt sharp.ply PHOTO...
 *     ./refine model.safetensors cameras.txt sharp.ply PHOTO...
 * With a model, reconstructs the scene and refines its tokens.
 * cameras.txt has 16 numbers per photo: fx fy cx cy in pixels, the row-major camera-to-world
 * rotation and the camera's center, in the scene's world. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zipsplat.h>

#define CHECK(call)                                                                \
    do {                                                                           \
        zs_status status_ = (call);                                                \
        if (status_ != ZS_OK) {                                                    \
            fprintf(stderr, "%s: %s\n", zs_status_name(status_), zs_last_error()); \
            goto done;                                                             \
        }                                                                          \
    } while (0)

enum { MAX_PHOTOS = 1000 };

static zs_progress_action show(void *user_data, const zs_progress *now) {
    (void)user_data;
    fprintf(stderr, "step %zu of %zu, loss %.4f, %.0f s left\n", now->step, now->steps, now->loss, now->eta_seconds);
    return ZS_CONTINUE; /* ZS_STOP ends with the best scene so far */
}

static int read_camera(FILE *file, const zs_image *photo, zs_camera *camera) {
    double numbers[16];
    for (int i = 0; i < 16; i++) {
        if (fscanf(file, "%lf", &numbers[i]) != 1) return 0;
    }
    *camera = ZS_INIT(zs_camera);
    camera->width = photo->width, camera->height = photo->height;
    camera->fx = numbers[0], camera->fy = numbers[1], camera->cx = numbers[2], camera->cy = numbers[3];
    for (int i = 0; i < 9; i++) camera->rotation[i] = numbers[4 + i];
    for (int i = 0; i < 3; i++) camera->translation[i] = numbers[13 + i];
    return 1;
}

int main(int argc, char **argv) {
    if (argc < 5 || argc - 4 > MAX_PHOTOS) {
        fprintf(stderr, "usage: %s scene.ply|model.safetensors cameras.txt sharp.ply PHOTO... (at most %d)\n", argv[0], MAX_PHOTOS);
        return 2;
    }
    int result = EXIT_FAILURE;
    const size_t count = (size_t)argc - 4;
    zs_device *device = NULL;
    zs_model *model = NULL;
    zs_reconstruction *reconstruction = NULL;
    zs_scene *scene = NULL, *sharp = NULL;
    static zs_image_buffer *photos[MAX_PHOTOS];
    static zs_image images[MAX_PHOTOS];
    static zs_camera cameras[MAX_PHOTOS];
    FILE *file = fopen(argv[2], "r");

    CHECK(zs_device_create(NULL, &device));
    for (size_t i = 0; i < count; i++) {
        images[i] = ZS_INIT(zs_image);
        CHECK(zs_image_buffer_open(argv[4 + i], &photos[i]));
        CHECK(zs_image_buffer_get_image(photos[i], &images[i]));
        if (!file || !read_camera(file, &images[i], &cameras[i])) {
            fprintf(stderr, "%s: no camera for photo %s\n", argv[2], argv[4 + i]);
            goto done;
        }
    }
    zs_refine_options options = ZS_INIT(zs_refine_options);
    zs_refine_result info = ZS_INIT(zs_refine_result);
    options.steps = 100;
    options.progress = show;
    if (strstr(argv[1], ".safetensors")) {
        zs_model_options of_model = ZS_INIT(zs_model_options);
        of_model.tokens = 1;
        CHECK(zs_model_load(device, argv[1], &of_model, &model));
        zs_reconstruct_options of_scene = ZS_INIT(zs_reconstruct_options);
        of_scene.cameras = cameras, of_scene.camera_count = count;
        CHECK(zs_reconstruct(model, images, count, &of_scene, &reconstruction));
        options.target = ZS_REFINE_TARGET_TOKENS;
        CHECK(zs_refine_reconstruction(reconstruction, images, cameras, count, &options, &info, &sharp));
    } else {
        CHECK(zs_scene_open(argv[1], NULL, &scene));
        CHECK(zs_refine_scene(device, scene, images, cameras, count, &options, &info, &sharp));
    }
    CHECK(zs_scene_save(sharp, argv[3], NULL));
    printf("%u steps in %.1f s: loss %.4f to %.4f; kept is step %u", info.steps, info.seconds, info.initial_loss,
           info.final_loss, info.best_step);
    /* With 40 or more photos one is held out against overfitting. */
    if (info.best_psnr == info.best_psnr) printf("; held-out photos %.2f to %.2f dB", info.initial_psnr, info.best_psnr);
    printf("\n");
    result = EXIT_SUCCESS;

done:
    for (size_t i = 0; i < count; i++) zs_image_buffer_destroy(photos[i]);
    zs_scene_destroy(sharp);
    zs_scene_destroy(scene);
    zs_reconstruction_destroy(reconstruction);
    zs_model_destroy(model);
    zs_device_destroy(device);
    if (file) fclose(file);
    return result;
}
