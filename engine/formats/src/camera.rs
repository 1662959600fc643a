//! Pinhole cameras: intrinsics in pixels (centers at +0.5), camera-to-world poses, OpenCV axes.

use glam::{DMat3, DMat4, DQuat, DVec3};

use crate::{Error, Result};

/// Tolerance of each entry of `R Rᵀ - I`: some files store four decimals.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Pinhole projection: `u = fx x/z + cx`, `v = fy y/z + cy`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Principal point from the left edge, in pixels.
    pub cx: f64,
    /// Principal point from the top edge, in pixels.
    pub cy: f64,
}

impl Intrinsics {
    /// Creates intrinsics from fields of view in radians, with a centered principal point.
    pub fn from_fov(width: u32, height: u32, hfov: f64, vfov: f64) -> Self {
        let (w, h) = (f64::from(width), f64::from(height));
        let focal = |size: f64, fov: f64| size / (2.0 * (fov / 2.0).tan());
        Self { width, height, fx: focal(w, hfov), fy: focal(h, vfov), cx: w / 2.0, cy: h / 2.0 }
    }

    /// Returns the horizontal field of view in radians.
    pub fn hfov(&self) -> f64 {
        2.0 * (f64::from(self.width) / (2.0 * self.fx)).atan()
    }

    /// Returns the vertical field of view in radians.
    pub fn vfov(&self) -> f64 {
        2.0 * (f64::from(self.height) / (2.0 * self.fy)).atan()
    }

    /// Returns the calibration matrix `K`.
    pub fn matrix(&self) -> DMat3 {
        DMat3::from_cols_array_2d(&[[self.fx, 0.0, 0.0], [0.0, self.fy, 0.0], [self.cx, self.cy, 1.0]])
    }

    /// Returns the intrinsics of a crop from (`left`, `top`).
    pub fn crop(&self, left: i32, top: i32, width: u32, height: u32) -> Self {
        Self { width, height, cx: self.cx - f64::from(left), cy: self.cy - f64::from(top), ..*self }
    }

    /// Returns the intrinsics of the resized picture.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }
}

/// Rigid transform: `x_world = rotation * x_camera + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Camera axes in the world; columns right, down, forward.
    pub rotation: DMat3,
    /// Camera center in the world.
    pub translation: DVec3,
}

impl Pose {
    /// Identity.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Returns the inverse transform.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Returns `self * inner`: applies `inner` first.
    pub fn compose(&self, inner: &Self) -> Self {
        Self { rotation: self.rotation * inner.rotation, translation: self.transform(inner.translation) }
    }

    /// Returns the pose relative to `first`.
    pub fn relative_to(&self, first: &Self) -> Self {
        first.inverse().compose(self)
    }

    /// Maps a camera-space point to the world.
    pub fn transform(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Returns the camera-to-world matrix.
    pub fn matrix(&self) -> DMat4 {
        DMat4::from_mat3_translation(self.rotation, self.translation)
    }

    /// Returns the world-to-camera matrix (`viewmat`).
    pub fn view_matrix(&self) -> DMat4 {
        self.inverse().matrix()
    }
}

/// A pinhole camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Projection and picture size.
    pub intrinsics: Intrinsics,
    /// Camera-to-world pose.
    pub pose: Pose,
}

impl Camera {
    /// Creates a camera with square pixels at the origin.
    pub fn from_hfov_deg(width: u32, height: u32, hfov_deg: f64) -> Self {
        let focal = f64::from(width) / 2.0 / (hfov_deg.to_radians() / 2.0).tan();
        let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        Self { intrinsics: Intrinsics { fx: focal, fy: focal, cx, cy, width, height }, pose: Pose::IDENTITY }
    }

    /// Returns the world-to-camera matrix (`viewmat`).
    pub fn view_matrix(&self) -> DMat4 {
        self.pose.view_matrix()
    }

    /// Returns the camera of its picture turned clockwise by quarter turns.
    pub fn turned(&self, quarters: u32) -> Self {
        (0..quarters % 4).fold(*self, |Self { intrinsics: lens, pose }, _| {
            let cx = f64::from(lens.height) - lens.cy;
            let intrinsics =
                Intrinsics { fx: lens.fy, fy: lens.fx, cx, cy: lens.cx, width: lens.height, height: lens.width };
            let DMat3 { x_axis: right, y_axis: down, z_axis: forward } = pose.rotation;
            Self { intrinsics, pose: Pose { rotation: DMat3::from_cols(-down, right, forward), ..pose } }
        })
    }

    /// Returns the camera after its world moved: x becomes `pose(scale x)`.
    pub fn placed(&self, scale: f64, pose: &Pose) -> Self {
        let translation = pose.transform(scale * self.pose.translation);
        Self { pose: Pose { rotation: pose.rotation * self.pose.rotation, translation }, ..*self }
    }

    /// Returns the camera in a world where `pose` is the identity.
    pub fn relative_to(&self, pose: &Pose) -> Self {
        Self { pose: self.pose.relative_to(pose), ..*self }
    }

    /// Returns a world point's pixel coordinates and depth, if it is in the picture.
    pub fn project(&self, point: DVec3) -> Option<DVec3> {
        let (i, p) = (&self.intrinsics, self.pose.inverse().transform(point));
        let (x, y) = (i.fx * p.x / p.z + i.cx, i.fy * p.y / p.z + i.cy);
        let inside = (0.0..f64::from(i.width)).contains(&x) && (0.0..f64::from(i.height)).contains(&y);
        (p.z > 0.0 && inside).then_some(DVec3::new(x, y, p.z))
    }

    /// Checks for finite values, a non-empty picture, positive focal lengths and a valid rotation.
    ///
    /// # Errors
    /// [`Error::Argument`] with the field and `name`, such as `camera 3`.
    pub fn validate(&self, name: &str) -> Result<()> {
        let Self { intrinsics: i, pose } = self;
        let fail = |field: &str, found: String, expected: &str| {
            Err(Error::argument(format!("{name}, {field}"), found, expected))
        };
        if i.width == 0 || i.height == 0 {
            return fail("size", format!("{}x{}", i.width, i.height), "at least 1 pixel on each side");
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

/// Returns the camera encoder's input per view: `[t (3), quaternion xyzw (4), vfov, hfov]`, world
/// to camera, in radians. Poses must be relative to the first view, at the model's scale.
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

/// Returns the input of Depth Anything 3's camera encoder per view: `[center (3), quaternion xyzw
/// (4), vfov, hfov]`, camera to world, in radians. Poses are relative to the first; centers are
/// divided by their median distance from it, at least 0.1.
pub fn relative_encoding(cameras: &[Camera]) -> Result<Vec<[f32; 9]>> {
    cameras.iter().enumerate().try_for_each(|(i, camera)| camera.validate(&format!("camera {i}")))?;
    let poses: Vec<Pose> = cameras.iter().map(|camera| camera.pose.relative_to(&cameras[0].pose)).collect();
    let mut distances: Vec<f64> = poses.iter().map(|pose| pose.translation.length()).collect();
    distances.sort_by(f64::total_cmp);
    let unit = distances.get(distances.len().saturating_sub(1) / 2).map_or(1.0, |median| median.max(0.1));
    let encode = |(camera, pose): (&Camera, &Pose)| {
        let ([w, x, y, z], t) = (quaternion_from_matrix(&pose.rotation), pose.translation / unit);
        [t.x, t.y, t.z, x, y, z, w, camera.intrinsics.vfov(), camera.intrinsics.hfov()].map(|value| value as f32)
    };
    Ok(cameras.iter().zip(&poses).map(encode).collect())
}

/// Returns the unit quaternion `wxyz` of a rotation, `w >= 0`.
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
    // The squares sum to 4, so the largest is at least 1.
    let sign = if products[0] < 0.0 { -1.0 } else { 1.0 };
    products.map(|product| sign * product / (2.0 * squares[largest].sqrt()))
}

/// Normalizes a nonzero quaternion in f64: squares of f32 may overflow or vanish.
pub fn unit_quaternion(quat: [f32; 4]) -> [f32; 4] {
    let quat = quat.map(f64::from);
    let length = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
    quat.map(|q| (q / length) as f32)
}

/// Returns the rotation matrix of a quaternion `wxyz`.
pub fn matrix_from_quaternion([w, x, y, z]: [f64; 4]) -> DMat3 {
    DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
}
