//! The range of numbers that kernels compute with, and with it what can be drawn.

use super::RenderRequest;
use crate::{Error, Result, types::Camera};
use std::borrow::Cow;

/// Longest side of a picture: its pixels count in 32 bits, and the kernels' margins for rounding hold.
pub const MAX_SIDE: u32 = 1 << 15;
/// Largest coordinate of a camera's centre, and the least and largest numbers of its lens, in pixels: kernels compute in f32.
const FARTHEST: f64 = 1e30;
const LENS: [f64; 2] = [1e-3, 1e10];
/// The longest component of a rotation lies between these when kernels get it: a device may take a subnormal number for 0,
/// and may divide by a very large one wrongly.
const TURN: [f32; 2] = [1.0 / (1u128 << 100) as f32, (1u128 << 100) as f32];

/// Holds that these pictures can be drawn.
pub(super) fn check(cameras: &[Camera], request: &RenderRequest) -> Result<()> {
    if request.channels() == 0 {
        let expected = "one of rgb, alpha, depth, normals and token colours";
        return Err(Error::argument("render request", "no output", expected));
    }
    for (i, camera) in cameras.iter().enumerate() {
        camera.validate(&format!("camera {i}"))?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        if size.0.max(size.1) > MAX_SIDE {
            let found = format!("{} x {}", size.0, size.1);
            return Err(Error::argument(format!("size of camera {i}"), found, format!("sides up to {MAX_SIDE}")));
        }
        check_range(camera).map_err(|(field, found, expected)| {
            Error::argument(format!("camera {i}, {field}"), format!("{found:e}"), format!("{expected} to draw with it"))
        })?;
    }
    Ok(())
}

/// Holds that f32 can compute with a camera; gives the field that it cannot compute with, its value and what it can.
fn check_range(camera: &Camera) -> Result<(), (&'static str, f64, String)> {
    let (i, centre) = (&camera.intrinsics, camera.pose.translation);
    for (field, focal) in [("fx", i.fx), ("fy", i.fy)] {
        if !(LENS[0]..=LENS[1]).contains(&focal) {
            return Err((field, focal, format!("{:e} to {:e} pixels", LENS[0], LENS[1])));
        }
    }
    for (field, value, most) in [
        ("cx", i.cx, LENS[1]),
        ("cy", i.cy, LENS[1]),
        ("translation x", centre.x, FARTHEST),
        ("translation y", centre.y, FARTHEST),
        ("translation z", centre.z, FARTHEST),
    ] {
        if value.abs() > most {
            return Err((field, value, format!("-{most:e} to {most:e}")));
        }
    }
    Ok(())
}

/// Rotations whose length is within what kernels compute with: the others times a power of two, which turns nothing.
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
