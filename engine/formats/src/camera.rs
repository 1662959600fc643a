//! Pinhole cameras: intrinsics in pixels with pixel centres at +0.5, poses camera-to-world, OpenCV axes (x right,
//! y down, z forward).

use glam::{DMat3, DMat4, DQuat, DVec3};

use crate::{Error, Result};

/// How far `R Rᵀ` may be from the identity, per entry: files carry rotations with as few as four decimals.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// The map from directions to pixels: `u = fx x/z + cx`, `v = fy y/z + cy`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Pixels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Principal point from the left edge, in pixels.
    pub cx: f64,
    /// Principal point from the top edge, in pixels.
    pub cy: f64,
}

impl Intrinsics {
    /// From horizontal and vertical fields of view in radians, the principal point in the centre.
    pub fn from_fov(width: u32, height: u32, hfov: f64, vfov: f64) -> Self {
        let (w, h) = (f64::from(width), f64::from(height));
        let focal = |size: f64, fov: f64| size / (2.0 * (fov / 2.0).tan());
        Self { width, height, fx: focal(w, hfov), fy: focal(h, vfov), cx: w / 2.0, cy: h / 2.0 }
    }

    /// Horizontal field of view in radians; the principal point is ignored, as in the reference.
    pub fn hfov(&self) -> f64 {
        2.0 * (f64::from(self.width) / (2.0 * self.fx)).atan()
    }

    /// Vertical field of view in radians; the principal point is ignored.
    pub fn vfov(&self) -> f64 {
        2.0 * (f64::from(self.height) / (2.0 * self.fy)).atan()
    }

    /// `K` of `pixel ~ K direction`.
    pub fn matrix(&self) -> DMat3 {
        DMat3::from_cols_array_2d(&[[self.fx, 0.0, 0.0], [0.0, self.fy, 0.0], [self.cx, self.cy, 1.0]])
    }

    /// The intrinsics of the picture's rectangle of `width` x `height` pixels whose first pixel is (`left`, `top`); a negative start
    /// pads.
    pub fn crop(&self, left: i32, top: i32, width: u32, height: u32) -> Self {
        Self { width, height, cx: self.cx - f64::from(left), cy: self.cy - f64::from(top), ..*self }
    }

    /// The intrinsics of the picture scaled to `width` x `height` pixels.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }
}

/// Where a camera stands: `x_world = rotation * x_camera + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Camera axes in the world: the columns are right, down and forward.
    pub rotation: DMat3,
    /// Camera centre in the world.
    pub translation: DVec3,
}

impl Pose {
    /// The world frame's own pose.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// World-to-camera for a camera-to-world pose, and the other way round.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// `self` after `inner`: maps by `inner` first.
    pub fn compose(&self, inner: &Self) -> Self {
        Self { rotation: self.rotation * inner.rotation, translation: self.transform(inner.translation) }
    }

    /// The pose in the frame of `first`, which becomes the identity.
    pub fn relative_to(&self, first: &Self) -> Self {
        first.inverse().compose(self)
    }

    /// A camera-space point in the world.
    pub fn transform(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Camera-to-world matrix.
    pub fn matrix(&self) -> DMat4 {
        DMat4::from_mat3_translation(self.rotation, self.translation)
    }

    /// World-to-camera matrix (`viewmat`).
    pub fn view_matrix(&self) -> DMat4 {
        self.inverse().matrix()
    }
}

/// A camera: what it sees and from where.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Lens and picture size.
    pub intrinsics: Intrinsics,
    /// Camera-to-world pose.
    pub pose: Pose,
}

impl Camera {
    /// World-to-camera matrix (`viewmat`).
    pub fn view_matrix(&self) -> DMat4 {
        self.pose.view_matrix()
    }

    /// Whether a point in the world falls into the picture.
    pub fn sees(&self, point: DVec3) -> bool {
        let (i, p) = (&self.intrinsics, self.pose.inverse().transform(point));
        let (x, y) = (i.fx * p.x / p.z + i.cx, i.fy * p.y / p.z + i.cy);
        p.z > 0.0 && (0.0..f64::from(i.width)).contains(&x) && (0.0..f64::from(i.height)).contains(&y)
    }

    /// Checks that everything is finite, the picture not empty, the focal lengths positive and the rotation one.
    ///
    /// # Errors
    /// [`Error::Argument`] naming `name` (as `camera 3`) and the field.
    pub fn validate(&self, name: &str) -> Result<()> {
        let Self { intrinsics: i, pose } = self;
        let fail = |field: &str, found: String, expected: &str| {
            Err(Error::argument(format!("{name}, {field}"), found, expected))
        };
        if i.width == 0 || i.height == 0 {
            return fail("size", format!("{}x{}", i.width, i.height), "no empty side");
        }
        for (field, focal) in [("fx", i.fx), ("fy", i.fy)] {
            if !(focal.is_finite() && focal > 0.0) {
                return fail(field, focal.to_string(), "a positive number of pixels");
            }
        }
        if !i.cx.is_finite() || !i.cy.is_finite() {
            return fail("principal point", format!("({}, {})", i.cx, i.cy), "finite numbers");
        }
        let r = pose.rotation;
        let orthonormal = (r * r.transpose()).abs_diff_eq(DMat3::IDENTITY, ROTATION_TOLERANCE);
        let right_handed = r.determinant() > 0.0;
        if !orthonormal || !right_handed {
            return fail("rotation", r.to_string(), "an orthonormal, right-handed matrix");
        }
        if !pose.translation.is_finite() {
            return fail("translation", pose.translation.to_string(), "finite numbers");
        }
        Ok(())
    }
}

/// The camera encoder's input, per view `[t (3), quaternion xyzw (4), vfov, hfov]` of the world-to-camera pose, radians.
/// Poses are used as given: make them relative to the first view and of the model's scale before.
///
/// # Errors
/// [`Error::Argument`] naming the first camera that is not valid by its index.
pub fn prior_encoding(cameras: &[Camera]) -> Result<Vec<[f32; 9]>> {
    let encode = |(i, camera): (usize, &Camera)| {
        camera.validate(&format!("camera {i}"))?;
        let view = camera.pose.inverse();
        let [w, x, y, z] = quaternion_from_matrix(&view.rotation);
        let t = view.translation;
        Ok([t.x, t.y, t.z, x, y, z, w, camera.intrinsics.vfov(), camera.intrinsics.hfov()].map(|value| value as f32))
    };
    cameras.iter().enumerate().map(encode).collect()
}

/// The input of Depth Anything 3's camera encoder, per view `[centre (3), quaternion xyzw (4), vfov, hfov]` of the camera-to-world
/// pose, radians: poses relative to the first, centres divided by their median distance from it, which is taken as 0.1 at least.
///
/// # Errors
/// [`Error::Argument`] naming the first camera that is not valid by its index.
pub fn relative_encoding(cameras: &[Camera]) -> Result<Vec<[f32; 9]>> {
    cameras.iter().enumerate().try_for_each(|(i, camera)| camera.validate(&format!("camera {i}")))?;
    let poses: Vec<Pose> = cameras.iter().map(|camera| camera.pose.relative_to(&cameras[0].pose)).collect();
    let mut distances: Vec<f64> = poses.iter().map(|pose| pose.translation.length()).collect();
    distances.sort_by(f64::total_cmp);
    // Of an even number, the lower of the two in the middle.
    let unit = distances.get(distances.len().saturating_sub(1) / 2).map_or(1.0, |median| median.max(0.1));
    let encode = |(camera, pose): (&Camera, &Pose)| {
        let ([w, x, y, z], t) = (quaternion_from_matrix(&pose.rotation), pose.translation / unit);
        [t.x, t.y, t.z, x, y, z, w, camera.intrinsics.vfov(), camera.intrinsics.hfov()].map(|value| value as f32)
    };
    Ok(cameras.iter().zip(&poses).map(encode).collect())
}

/// Unit quaternion `wxyz` of a rotation, `w >= 0`. The component that is largest by magnitude is found from the
/// diagonal and the others are divided by it, so nothing cancels near half turns.
pub fn quaternion_from_matrix(rotation: &DMat3) -> [f64; 4] {
    let [x, y, z] = rotation.transpose().to_cols_array_2d();
    let squares =
        [1.0 + x[0] + y[1] + z[2], 1.0 + x[0] - y[1] - z[2], 1.0 - x[0] + y[1] - z[2], 1.0 - x[0] - y[1] + z[2]];
    let largest = (1..4).fold(0, |best, i| if squares[i] > squares[best] { i } else { best });
    let products = match largest {
        0 => [squares[0], z[1] - y[2], x[2] - z[0], y[0] - x[1]],
        1 => [z[1] - y[2], squares[1], y[0] + x[1], x[2] + z[0]],
        2 => [x[2] - z[0], y[0] + x[1], squares[2], y[2] + z[1]],
        _ => [y[0] - x[1], x[2] + z[0], y[2] + z[1], squares[3]],
    };
    // The squares add up to 4, so the largest is at least 1 and the reference's floor under this divisor never acts.
    let sign = if products[0] < 0.0 { -1.0 } else { 1.0 };
    products.map(|product| sign * product / (2.0 * squares[largest].sqrt()))
}

/// A quaternion of any length but zero, of length 1: in f64, where no square of an f32 overflows or vanishes.
pub fn unit_quaternion(quat: [f32; 4]) -> [f32; 4] {
    let quat = quat.map(f64::from);
    let length = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
    quat.map(|q| (q / length) as f32)
}

/// Rotation matrix of a quaternion `wxyz` of any length but zero.
pub fn matrix_from_quaternion([w, x, y, z]: [f64; 4]) -> DMat3 {
    DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
}
