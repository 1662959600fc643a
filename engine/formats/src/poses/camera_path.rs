//! `camera_path.json` of nerfstudio's viewer: OpenGL cameras, row-major, with vertical fields of
//! view.

use serde_json::Value;

use super::super::{Camera, Intrinsics};
use super::matrix::{from_opengl, rigid_matrix, whole};
use super::{Capture, CaptureView, checked};

const ASPECT_TOLERANCE: f64 = 1e-2;

/// As nerfstudio, assumes square pixels and ignores `aspect`.
pub(super) fn parse(file: &Value) -> Result<Capture, String> {
    check_perspective(file, "camera_type")?;
    let side = |key: &str| whole(file, key, "the file")?.ok_or_else(|| format!("{key}: expected a number of pixels"));
    let (width, height) = (side("render_width")?, side("render_height")?);
    let path = file["camera_path"].as_array().ok_or("camera_path: expected a list")?;
    let mut poses = Capture::default();
    let mut other_aspects = 0;
    for (i, frame) in path.iter().enumerate() {
        let name = format!("camera_path[{i}]");
        check_perspective(frame, &format!("{name}.camera_type"))?;
        let matrix = frame.get("camera_to_world").and_then(rigid_matrix);
        let matrix = matrix.ok_or_else(|| format!("{name}.camera_to_world: expected 16 numbers, the last 0 0 0 1"))?;
        let fov = frame.get("fov").and_then(Value::as_f64).filter(|fov| *fov > 0.0 && *fov < 180.0);
        let fov = fov.ok_or_else(|| format!("{name}.fov: expected degrees between 0 and 180"))?;
        let aspect = f64::from(width) / f64::from(height);
        let written = frame.get("aspect").and_then(Value::as_f64).unwrap_or(aspect);
        other_aspects += usize::from((written / aspect - 1.0).abs() > ASPECT_TOLERANCE);
        let vfov = fov.to_radians();
        let mut intrinsics = Intrinsics::from_fov(width, height, vfov, vfov);
        intrinsics.fx = intrinsics.fy;
        let camera = checked(Camera { intrinsics, pose: from_opengl(matrix) }, &name)?;
        poses.frames.push(CaptureView { name, photo: None, camera, lens: None });
    }
    if other_aspects > 0 {
        poses.warnings.push(format!("aspect of {other_aspects} cameras is ignored: pictures are {width}x{height}"));
    }
    Ok(poses)
}

fn check_perspective(value: &Value, label: &str) -> Result<(), String> {
    match value.get("camera_type").and_then(Value::as_str) {
        Some(model) if !model.eq_ignore_ascii_case("perspective") => {
            Err(format!("{label}: found {model}, expected perspective"))
        }
        _ => Ok(()),
    }
}
