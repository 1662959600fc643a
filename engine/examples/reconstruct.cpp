// As reconstruct.c, in C++17: objects destroy themselves, failures are exceptions, Gaussians are vectors.
//     c++ -std=c++17 reconstruct.cpp $(pkg-config --cflags --libs zipsplat) -o reconstruct
//     ./reconstruct MODEL scene.ply PHOTO...
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

using Context = Handle<zs_context, zs_context_destroy>;
using Model = Handle<zs_model, zs_model_destroy>;
using Photo = Handle<zs_photo, zs_photo_destroy>;
using Scene = Handle<zs_scene, zs_scene_destroy>;

// make<Scene>(zs_scene_open, "scene.ply"): calls a function that hands out an object through its last argument.
template <class H, class Function, class... Arguments>
H make(Function function, Arguments... arguments) {
    typename H::pointer object = nullptr;
    check(function(arguments..., &object));
    return H(object);
}

struct Gaussians {
    std::vector<float> means, scales, quats, opacities, sh_coeffs;

    explicit Gaussians(const zs_scene *scene) {
        zs_scene_info info{};
        info.struct_size = sizeof info;
        check(zs_scene_get_info(scene, &info));
        const auto n = static_cast<size_t>(info.count);
        const size_t k = (info.sh_degree + 1) * (info.sh_degree + 1);
        means.resize(3 * n), scales.resize(3 * n), quats.resize(4 * n), opacities.resize(n), sh_coeffs.resize(3 * k * n);
        zs_gaussians arrays{};
        arrays.struct_size = sizeof arrays;
        arrays.sh_degree = info.sh_degree;
        arrays.count = info.count;
        arrays.means = means.data(), arrays.scales = scales.data(), arrays.quats = quats.data();
        arrays.opacities = opacities.data(), arrays.sh_coeffs = sh_coeffs.data();
        check(zs_scene_read(scene, &arrays));
    }
};

} // namespace zs

int main(int argc, char **argv) try {
    if (argc < 4) {
        std::fprintf(stderr, "usage: %s MODEL scene.ply PHOTO...\n", argv[0]);
        return 2;
    }
    auto context = zs::make<zs::Context>(zs_context_create, nullptr);
    auto model = zs::make<zs::Model>(zs_model_open, context.get(), argv[1], nullptr);
    context.reset(); // the model keeps what it needs

    std::vector<zs::Photo> photos;
    std::vector<zs_image> images;
    for (int i = 3; i < argc; i++) {
        photos.push_back(zs::make<zs::Photo>(zs_photo_open, argv[i]));
        images.emplace_back();
        zs::check(zs_photo_get_image(photos.back().get(), &images.back()));
    }
    zs_reconstruct_options options{};
    zs::check(zs_reconstruct_options_default(&options, sizeof options));
    options.ratio = ZS_RATIO_AUTO;
    auto scene = zs::make<zs::Scene>(zs_reconstruct, model.get(), images.data(), images.size(), &options);
    zs::check(zs_scene_save(scene.get(), argv[2], nullptr));

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
