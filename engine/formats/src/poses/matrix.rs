use glam::{DMat3, DMat4, DVec3};
use serde_json::Value;

use super::super::{Camera, Intrinsics, Pose};
use super::{Capture, CaptureView, checked};

/// Parses rows of 4 numbers or a flat row-major list. The last row, 0 0 0 1, is optional.
pub(super) fn rigid_matrix(value: &Value) -> Option<DMat4> {
    let mut numbers = Vec::new();
    for element in value.as_array()? {
        match element.as_array() {
            Some(row) if row.len() == 4 => numbers.extend(row.iter().map(Value::as_f64)),
            Some(_) => return None,
            None => numbers.push(element.as_f64()),
        }
    }
    let mut numbers: Vec<f64> = numbers.into_iter().collect::<Option<_>>()?;
    if numbers.len() == 12 {
        numbers.extend([0.0, 0.0, 0.0, 1.0]);
    }
    let rows = DMat4::from_cols_array(&numbers.try_into().ok()?);
    let [a, b, c, d] = rows.w_axis.to_array();
    ((a.abs() + b.abs() + c.abs() + (d - 1.0).abs()) < 1e-6).then(|| rows.transpose())
}

fn from_opencv(matrix: DMat4) -> Pose {
    Pose { rotation: DMat3::from_mat4(matrix), translation: matrix.w_axis.truncate() }
}

/// Converts a camera-to-world pose from OpenGL axes (x right, y up, z backward).
pub(super) fn from_opengl(matrix: DMat4) -> Pose {
    let pose = from_opencv(matrix);
    Pose { rotation: pose.rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), ..pose }
}

pub(super) fn parse_list(list: &[Value], lens: &Intrinsics) -> Result<Capture, String> {
    let mut poses = Capture::default();
    for (i, element) in list.iter().enumerate() {
        let name = format!("[{i}]");
        let camera = parse_camera(element, lens, &name)?;
        poses.frames.push(CaptureView { camera: checked(camera, &name)?, name, photo: None, lens: None });
    }
    Ok(poses)
}

fn parse_camera(element: &Value, lens: &Intrinsics, label: &str) -> Result<Camera, String> {
    let fail = || format!("{label}: expected a matrix of 4 rows of 4 numbers, the last 0 0 0 1");
    let pose = |value: &Value| rigid_matrix(value).map(from_opencv).ok_or_else(fail);
    if element.is_array() {
        return Ok(Camera { intrinsics: *lens, pose: pose(element)? });
    }
    let pose = match (element.get("matrix"), element.get("viewmat")) {
        (Some(matrix), None) => pose(matrix)?,
        (None, Some(viewmat)) => checked(Camera { intrinsics: *lens, pose: pose(viewmat)? }, label)?.pose.inverse(),
        _ => return Err(format!("{label}: expected a matrix, or an object with either matrix or viewmat")),
    };
    Ok(Camera { intrinsics: parse_lens(element, label)?.unwrap_or(*lens), pose })
}

fn parse_lens(camera: &Value, label: &str) -> Result<Option<Intrinsics>, String> {
    let number = |key: &str| match camera.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(value) => {
            value.as_f64().map(Some).ok_or_else(|| format!("{label}.{key}: found {value}, expected a number"))
        }
    };
    let [fx, fy, cx, cy] = [number("fx")?, number("fy")?, number("cx")?, number("cy")?];
    let [width, height] = [whole(camera, "width", label)?, whole(camera, "height", label)?];
    match (fx, width, height) {
        (Some(fx), Some(width), Some(height)) => {
            let (cx, cy) = (cx.unwrap_or(f64::from(width) / 2.0), cy.unwrap_or(f64::from(height) / 2.0));
            Ok(Some(Intrinsics { width, height, fx, fy: fy.unwrap_or(fx), cx, cy }))
        }
        (None, None, None) if [fy, cx, cy].iter().all(Option::is_none) => Ok(None),
        _ => Err(format!("{label}: found a part of a lens, expected fx, width and height, or none of a lens")),
    }
}

pub(super) fn whole(value: &Value, key: &str, label: &str) -> Result<Option<u32>, String> {
    let Some(value) = value.get(key).filter(|value| !value.is_null()) else { return Ok(None) };
    let side = value.as_f64().filter(|side| side.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(side));
    let side = side.ok_or_else(|| format!("{label}.{key}: found {value}, expected a number of pixels"))?;
    Ok(Some(side as u32))
}
