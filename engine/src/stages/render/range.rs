use super::RenderOptions;
use crate::{Error, Result, types::Camera};
use std::borrow::Cow;

/// Maximum image side: 32-bit pixel indices, rounding margins.
pub const MAX_SIDE: u32 = 1 << 15;
/// Largest coordinate and range of intrinsics, for f32.
const FARTHEST: f64 = 1e30;
const LENS: [f64; 2] = [1e-3, 1e10];
/// Range of rotations: devices may flush subnormals and divide inexactly.
const TURN: [f32; 2] = [1.0 / (1u128 << 100) as f32, (1u128 << 100) as f32];

pub(super) fn check(cameras: &[Camera], options: &RenderOptions) -> Result<()> {
    if options.channels() == 0 {
        let expected = "one of rgb, alpha, depth, normals and token colors";
        return Err(Error::argument("render options", "no output", expected));
    }
    if let Some(near) = options.near.filter(|near| !(near.is_finite() && *near > 0.0)) {
        return Err(Error::argument("near plane", near, "a positive distance"));
    }
    if options.background.iter().any(|value| !value.is_finite()) {
        return Err(Error::argument("background", format!("{:?}", options.background), "finite values"));
    }
    for (i, camera) in cameras.iter().enumerate() {
        check_camera(i, camera)?;
    }
    Ok(())
}

/// Checks that pictures of camera `i` can be drawn.
pub fn check_camera(i: usize, camera: &Camera) -> Result<()> {
    camera.validate(&format!("camera {i}"))?;
    let size = (camera.intrinsics.width, camera.intrinsics.height);
    if size.0.max(size.1) > MAX_SIDE {
        let found = format!("{} x {}", size.0, size.1);
        return Err(Error::argument(format!("size of camera {i}"), found, format!("sides up to {MAX_SIDE}")));
    }
    check_range(camera).map_err(|(field, found, expected)| {
        Error::argument(format!("camera {i}, {field}"), format!("{found:e}"), format!("{expected} to draw with it"))
    })
}

fn check_range(camera: &Camera) -> Result<(), (&'static str, f64, String)> {
    let (i, center) = (&camera.intrinsics, camera.pose.translation);
    for (field, focal) in [("fx", i.fx), ("fy", i.fy)] {
        if !(LENS[0]..=LENS[1]).contains(&focal) {
            return Err((field, focal, format!("{:e} to {:e} pixels", LENS[0], LENS[1])));
        }
    }
    for (field, value, most) in [
        ("cx", i.cx, LENS[1]),
        ("cy", i.cy, LENS[1]),
        ("translation x", center.x, FARTHEST),
        ("translation y", center.y, FARTHEST),
        ("translation z", center.z, FARTHEST),
    ] {
        if value.abs() > most {
            return Err((field, value, format!("-{most:e} to {most:e}")));
        }
    }
    Ok(())
}

/// Scales rotations by powers of two into range.
pub(super) fn drawable(quats: &[[f32; 4]]) -> Cow<'_, [[f32; 4]]> {
    let factor = |quat: &[f32; 4]| match quat.iter().fold(0.0f32, |most, q| most.max(q.abs())) {
        largest if largest < TURN[0] => TURN[1],
        largest if largest > TURN[1] => TURN[0],
        _ => 1.0,
    };
    if quats.iter().all(|quat| factor(quat) == 1.0) {
        return quats.into();
    }
    quats.iter().map(|quat| quat.map(|q| q * factor(quat))).collect()
}
