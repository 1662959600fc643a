// reconstruct.c in C++17, with RAII, exceptions and vectors.
//     c++ -std=c++17 reconstruct.cpp $(pkg-config --cflags --libs zipsplat) -o reconstruct
//     ./reconstruct MODEL scene.ply picture.png PHOTO...
// MODEL: builtin, a checkpoint, or seeded:vits
#include <cstdio>
#include <exception>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>
#include <zipsplat.h>

namespace zs {

struct Error : std::runtime_error {
    explicit Error(zs_status status)
        : std::runtime_error(std::string(zs_status_name(status)) + ": " + zs_last_error()), status(status) {}
    zs_status status;
};

inline void check(zs_status status) {
    if (status != ZS_OK) {
        throw Error(status);
    }
}

template <class T, void (*destroy)(T *)>
struct Destroy {
    void operator()(T *object) const { destroy(object); }
};

template <class T, void (*destroy)(T *)>
using Handle = std::unique_ptr<T, Destroy<T, destroy>>;

using Device = Handle<zs_device, zs_device_destroy>;
using Model = Handle<zs_model, zs_model_destroy>;
using Photo = Handle<zs_image_buffer, zs_image_buffer_destroy>;
using Reconstruction = Handle<zs_reconstruction, zs_reconstruction_destroy>;
using Scene = Handle<zs_scene, zs_scene_destroy>;
using Renderer = Handle<zs_renderer, zs_renderer_destroy>;

// make<Scene>(zs_scene_open, "scene.ply", nullptr) calls a constructor with an output argument.
template <class H, class Function, class... Arguments>
H make(Function function, Arguments... arguments) {
    typename H::pointer object = nullptr;
    check(function(arguments..., &object));
    return H(object);
}

struct Gaussians {
    std::vector<float> means, scales, quats, opacities, sh_coeffs;

    explicit Gaussians(const zs_scene *scene) {
        auto found = ZS_INIT(zs_gaussians);
        check(zs_scene_get_gaussians(scene, &found));
        const size_t n = found.count;
        const size_t k = (found.sh_degree + 1) * (found.sh_degree + 1);
        means.assign(found.means, found.means + 3 * n), scales.assign(found.scales, found.scales + 3 * n);
        quats.assign(found.quats, found.quats + 4 * n), opacities.assign(found.opacities, found.opacities + n);
        sh_coeffs.assign(found.sh_coeffs, found.sh_coeffs + 3 * k * n);
    }
};

// Draws from the first photo's camera, the world's origin, with a field of view of 60 degrees.
inline void draw(const zs_device *device, const zs_scene *scene, uint32_t side, const char *path) {
    auto camera = ZS_INIT(zs_camera);
    camera.width = camera.height = side;
    camera.fx = camera.fy = 0.866 * side, camera.cx = camera.cy = 0.5 * side;
    camera.rotation[0] = camera.rotation[4] = camera.rotation[8] = 1;
    std::vector<unsigned char> pixels(size_t{4} * side * side);
    auto picture = ZS_INIT(zs_render_buffers);
    picture.pixels = pixels.data();
    const auto renderer = make<Renderer>(zs_renderer_create, device, scene);
    check(zs_render(renderer.get(), &camera, &picture, 1, nullptr));
    auto image = ZS_INIT(zs_image);
    image.format = ZS_PIXEL_RGBA8, image.width = image.height = side, image.pixels = pixels.data();
    check(zs_image_save_png(&image, path));
}

} // namespace zs

int main(int argc, char **argv) try {
    if (argc < 5) {
        std::fprintf(stderr, "usage: %s MODEL scene.ply picture.png PHOTO...\n", argv[0]);
        return 2;
    }
    const auto device = zs::make<zs::Device>(zs_device_create, nullptr);
    const auto model = zs::make<zs::Model>(zs_model_load, device.get(), argv[1], nullptr);
    std::vector<zs::Photo> photos;
    std::vector<zs_image> images;
    for (int i = 4; i < argc; i++) {
        photos.push_back(zs::make<zs::Photo>(zs_image_buffer_open, argv[i]));
        images.push_back(ZS_INIT(zs_image));
        zs::check(zs_image_buffer_get_image(photos.back().get(), &images.back()));
    }
    const auto reconstruction =
        zs::make<zs::Reconstruction>(zs_reconstruct, model.get(), images.data(), images.size(), nullptr);
    const auto scene = zs::make<zs::Scene>(zs_reconstruction_to_scene, reconstruction.get());
    zs::check(zs_scene_save(scene.get(), argv[2], nullptr));
    zs::draw(device.get(), scene.get(), 256, argv[3]);

    const zs::Gaussians gaussians(scene.get());
    double opacity = 0;
    for (float value : gaussians.opacities) {
        opacity += value;
    }
    const size_t count = gaussians.opacities.size();
    std::printf("%zu Gaussians, mean opacity %.3f\n", count, opacity / static_cast<double>(count));
} catch (const std::exception &error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
