use crate::{
    header::header,
    installation::{Linking, installation, runner, success},
};
use std::fmt::Write;
use zipsplat_c::*;

macro_rules! sizes {
    ($($name:ident)*) => { vec![$((stringify!($name), size_of::<$name>()),)*] };
}

/// Needs no list: the header's declarations follow from the sources.
#[test]
fn is_what_c_sees() {
    let sizes = sizes! {
        zs_status zs_progress_action zs_progress zs_device_kind zs_device_info zs_device_options zs_camera
        zs_pixel_format zs_masks zs_image zs_pixel_values zs_capture_view zs_capture_info zs_world zs_scene_info
        zs_gaussians zs_scene_open_options zs_scene_save_options zs_edit_kind zs_edit zs_precision zs_model_options
        zs_model_info zs_reconstruction_info zs_camera_estimate zs_token_selection zs_reconstruct_options
        zs_camera_source zs_depth_model_options zs_depth_model_info zs_depth_options zs_depth_result_info zs_depth_map
        zs_refine_target zs_exposure_mode zs_antialiasing zs_depth_loss zs_stop_reason zs_refine_options
        zs_refine_result zs_depth_mode zs_render_buffers zs_render_options zs_grad_outputs zs_gradients
        zs_requirement_kind zs_vulkan_requirement zs_vulkan_device zs_semaphore_point zs_vulkan_target
    };
    let header = header();
    let mut names = Vec::new();
    for line in header.lines() {
        let structure = line.strip_prefix("} ").and_then(|rest| rest.strip_suffix(";"));
        let enumeration = line.strip_prefix("ZS_ENUM(").and_then(|rest| rest.strip_suffix(") {"));
        names.extend(structure.or(enumeration));
    }
    assert_eq!(sizes.iter().map(|(name, _)| *name).collect::<Vec<_>>(), names);
    let mut program = "#include <stdio.h>\n#include <zipsplat.h>\nint main(void) {\n".to_owned();
    let mut listing = String::new();
    for (name, size) in &sizes {
        let _ = writeln!(program, "    printf(\"%zu {name}\\n\", sizeof({name}));");
        let _ = writeln!(listing, "{size} {name}");
    }
    program.push_str("    return 0;\n}\n");
    for source in ["layout.c", "layout.cpp"] {
        let found = success(runner(&installation().compile_text(source, &program, Linking::Shared)));
        assert_eq!(found, listing, "{source}");
    }
}

#[test]
fn versions_are_the_package_s() {
    let version = format!("{ZS_VERSION_MAJOR}.{ZS_VERSION_MINOR}.{ZS_VERSION_PATCH}");
    assert_eq!(version, env!("CARGO_PKG_VERSION"));
}
