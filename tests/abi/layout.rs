use crate::{
    header::{enumerations, root},
    installation::{Linking, installation, runner, success},
};
use std::{fmt::Write, mem::offset_of};
use zipsplat_c::*;

macro_rules! layout {
    ($($name:ident { $($field:ident),* })*) => {
        vec![$(
            (format!("sizeof({})", stringify!($name)), size_of::<$name>()),
            $((format!("offsetof({}, {})", stringify!($name), stringify!($field)), offset_of!($name, $field)),)*
        )*]
    };
}

macro_rules! numbers {
    ($($enumeration:ident { $($name:ident),* })*) => {
        vec![$($((stringify!($name).to_owned(), $enumeration::$name as usize),)*)*]
    };
}

fn structures() -> Vec<(String, usize)> {
    layout! {
        zs_progress { struct_size, reserved, fraction, stage, step, steps, loss, psnr, eta_seconds }
        zs_device_info { struct_size, index, usable, kind, memory_bytes, name, driver, unusable_reason, uuid }
        zs_device_options { struct_size, validation, max_memory_bytes, device, cache_dir }
        zs_image { struct_size, format, width, height, stride, pixels, mask, mask_stride, depth }
        zs_masks { struct_size, inverted, folder }
        zs_pixel_values { struct_size, width, height, reserved, values }
        zs_camera { struct_size, reserved, width, height, fx, fy, cx, cy, rotation, translation }
        zs_gaussians { struct_size, sh_degree, count, means, scales, quats, opacities, sh_coeffs, antialiased, reserved }
        zs_capture_info { struct_size, reserved, view_count, warnings }
        zs_capture_view { struct_size, reserved, name, path, camera }
        zs_scene_open_options { struct_size, drop_invalid, format }
        zs_scene_info { struct_size, world, gaussian_count, dropped_count }
        zs_scene_save_options { struct_size, spz_version }
        zs_edit { struct_size, kind, numbers }
        zs_model_options { struct_size, precision, variant, progress, user_data, tokens, reserved }
        zs_model_info {
            struct_size, image_size, patch_size, gaussians_per_token, sh_degree, precision, weight_bytes, warnings
        }
        zs_reconstruct_options {
            struct_size, world, ratio, scene_scale, token_selection, kv_pool, input_size, seed, camera_count, cameras,
            progress, user_data, capture, keep_features, block_size, block_overlap,
            reserved
        }
        zs_reconstruction_info { struct_size, has_tokens, view_count, token_count, gaussian_count, warnings, channel_count }
        zs_camera_estimate { struct_size, inliers, patches, reserved, camera }
        zs_depth_model_options { struct_size, precision, progress, user_data }
        zs_depth_model_info { struct_size, is_multi_view, patch_size, precision, weight_bytes, warnings }
        zs_depth_options {
            struct_size, input_size, camera_source, per_view_focal, camera_count, cameras, progress, user_data
        }
        zs_depth_result_info { struct_size, reserved, view_count }
        zs_depth_map { struct_size, reserved, width, height, depth, confidence, sky, camera, image_camera }
        zs_refine_options {
            struct_size, steps, views_per_step, holdout_views, max_image_size, target, optimize_cameras, perceptual_weight,
            exposure, seed, max_gaussians, progress, user_data, seconds, antialiasing, depth_loss, depth_weight, reserved
        }
        zs_refine_result {
            struct_size, stop_reason, steps, best_step, initial_loss, final_loss, initial_psnr, best_psnr, seconds,
            initial_training_psnr, best_training_psnr, cameras, exposures
        }
        zs_render_options { struct_size, format, depth, antialiasing, background, near_plane }
        zs_render_buffers { struct_size, reserved, stride, pixels, alpha, depth, normals }
        zs_grad_outputs { struct_size, reserved, color, alpha, depth }
        zs_gradients { struct_size, reserved, means, scales, quats, opacities, sh_coeffs, cameras, means2d }
        zs_vulkan_requirement { kind, optional, name, structure }
        zs_vulkan_device {
            struct_size, queue_family, get_instance_proc_addr, instance, physical_device, device, queue, lock_queue,
            unlock_queue, user_data, optional_features_enabled, reserved, cache_dir
        }
        zs_semaphore_point { semaphore, value }
        zs_vulkan_target {
            struct_size, reserved, image, x, y, mip_level, array_layer, old_layout, new_layout, buffer, buffer_offset,
            buffer_size, wait_count, signal_count, waits, signals
        }
    }
}

fn constants() -> Vec<(String, usize)> {
    let mut constants = numbers! {
        zs_status {
            ZS_OK, ZS_ERROR_ARGUMENT, ZS_ERROR_IO, ZS_ERROR_FORMAT, ZS_ERROR_WEIGHTS, ZS_ERROR_NO_DEVICE,
            ZS_ERROR_OUT_OF_MEMORY, ZS_ERROR_DRIVER, ZS_ERROR_DEVICE_LOST, ZS_ERROR_CANCELLED, ZS_ERROR_UNSUPPORTED,
            ZS_ERROR_INTERNAL
        }
        zs_progress_action { ZS_CONTINUE, ZS_STOP, ZS_CANCEL }
        zs_device_kind { ZS_DEVICE_OTHER, ZS_DEVICE_DISCRETE, ZS_DEVICE_INTEGRATED, ZS_DEVICE_CPU }
        zs_pixel_format { ZS_PIXEL_RGB8, ZS_PIXEL_RGBA8, ZS_PIXEL_BGRA8, ZS_PIXEL_RGB_F32, ZS_PIXEL_RGBA_F32 }
        zs_precision {
            ZS_PRECISION_AUTO, ZS_PRECISION_FP32, ZS_PRECISION_FP16, ZS_PRECISION_BF16, ZS_PRECISION_INT8
        }
        zs_token_selection { ZS_TOKEN_SELECTION_KMEANS, ZS_TOKEN_SELECTION_STRIDE, ZS_TOKEN_SELECTION_RANDOM }
        zs_world { ZS_WORLD_AUTO, ZS_WORLD_FIRST_CAMERA, ZS_WORLD_INPUT_CAMERAS }
        zs_edit_kind {
            ZS_EDIT_CROP_BOX, ZS_EDIT_CROP_SPHERE, ZS_EDIT_TRANSLATE, ZS_EDIT_ROTATE, ZS_EDIT_SCALE, ZS_EDIT_LEVEL,
            ZS_EDIT_MIN_OPACITY, ZS_EDIT_MAX_SIZE, ZS_EDIT_MIN_NEIGHBORS, ZS_EDIT_MIN_VIEWS, ZS_EDIT_CLEAN,
            ZS_EDIT_SH_DEGREE, ZS_EDIT_DECIMATE, ZS_EDIT_SORT
        }
        zs_camera_source { ZS_CAMERA_SOURCE_DECODER, ZS_CAMERA_SOURCE_RAYS }
        zs_refine_target { ZS_REFINE_TARGET_GAUSSIANS, ZS_REFINE_TARGET_TOKENS }
        zs_exposure_mode { ZS_EXPOSURE_AUTO, ZS_EXPOSURE_OFF, ZS_EXPOSURE_ON }
        zs_stop_reason { ZS_STOP_REASON_FINISHED, ZS_STOP_REASON_STOPPED, ZS_STOP_REASON_DIVERGED }
        zs_depth_mode { ZS_DEPTH_MODE_EXPECTED, ZS_DEPTH_MODE_ACCUMULATED }
        zs_depth_loss { ZS_DEPTH_LOSS_OFF, ZS_DEPTH_LOSS_METRIC, ZS_DEPTH_LOSS_RELATIVE }
        zs_antialiasing { ZS_ANTIALIASING_AUTO, ZS_ANTIALIASING_ON, ZS_ANTIALIASING_OFF }
        zs_requirement_kind { ZS_REQUIRES_API_VERSION, ZS_REQUIRES_DEVICE_EXTENSION, ZS_REQUIRES_FEATURE }
    };
    let versions = [ZS_VERSION_MAJOR, ZS_VERSION_MINOR, ZS_VERSION_PATCH, ZS_ABI_VERSION];
    let names = ["ZS_VERSION_MAJOR", "ZS_VERSION_MINOR", "ZS_VERSION_PATCH", "ZS_ABI_VERSION"];
    constants.extend(names.into_iter().map(str::to_owned).zip(versions.map(|version| version as usize)));
    let version = format!("{ZS_VERSION_MAJOR}.{ZS_VERSION_MINOR}.{ZS_VERSION_PATCH}");
    assert_eq!(version, env!("CARGO_PKG_VERSION"));
    constants
}

#[test]
fn is_what_c_sees() {
    let enumerations = enumerations().into_iter().chain(["zs_status".to_owned()]);
    let mut expected = [structures(), constants()].concat();
    expected.extend(enumerations.map(|name| (format!("sizeof({name})"), 4)));
    let mut program = "#include <stdio.h>\n#include <zipsplat.h>\nint main(void) {\n".to_owned();
    for (expression, _) in &expected {
        let _ = writeln!(program, "    printf(\"%zu %s\\n\", (size_t)({expression}), \"{expression}\");");
    }
    program.push_str("    return 0;\n}\n");
    let listing: String = expected.iter().fold(String::new(), |all, (name, value)| all + &format!("{value} {name}\n"));
    for source in ["layout.c", "layout.cpp"] {
        let found = success(runner(&installation().compile_text(source, &program, Linking::Shared)));
        assert_eq!(found, listing, "{source}");
    }
}

#[test]
fn nothing_was_left_out() {
    let header = std::fs::read_to_string(root().join("engine/bindings/c/include/zipsplat.h")).expect("the header");
    let lines = header.lines().map(str::trim);
    let code: Vec<&str> = lines.filter(|line| !line.starts_with("//")).collect();
    let structures = structures();
    let fields = structures.iter().filter(|(name, _)| name.starts_with("offsetof")).count();
    let bodies = code.join("\n");
    let bodies = bodies.split("typedef struct ").skip(1).filter_map(|part| part.split_once(" {\n"));
    let found: usize = bodies.map(|(_, rest)| rest.split('}').next().unwrap_or_default().matches(';').count()).sum();
    assert_eq!(
        (fields, structures.len() - fields),
        (found, code.iter().filter(|line| line.starts_with("} zs_")).count())
    );
    let numbers = code.iter().filter(|line| line.starts_with("ZS_") && line.ends_with(',')).count();
    assert_eq!(constants().len() - 4, numbers);
    let defined = code.iter().filter(|line| line.starts_with("#define ZS_") && !line.contains("(")).count();
    assert_eq!(defined, 4 + 4, "and ZS_MAX_VIEWS, ZS_RATIO_AUTO, ZS_SCENE_SCALE_AUTO, ZS_HOLDOUT_VIEWS_NONE");
}
