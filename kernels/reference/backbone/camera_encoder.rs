use super::block::{EPS, Options, block, mlp};
use crate::model::Scope;

#[derive(Clone, Copy, Debug)]
pub struct Prior {
    /// Width, height, fx, fy, cx, cy in pixels.
    pub camera: [f64; 6],
    /// Camera-to-world rotation, row-major, and center.
    pub pose: [f64; 12],
}

pub fn camera_tokens(weights: &Scope, priors: &[Prior], blocks: usize, heads: usize) -> Vec<f64> {
    let options = Options { heads, eps: EPS, sequences: 1, positions: None, pool: None };
    let encoded: Vec<f64> = priors.iter().flat_map(encode).collect();
    let mut x = weights.layer_norm("token_norm", &mlp(&weights.scope("pose_branch"), &encoded), EPS);
    for i in 0..blocks {
        x = block(&weights.scope(&format!("trunk.{i}")), &x, options);
    }
    weights.layer_norm("trunk_norm", &x, EPS)
}

/// Returns world-to-camera translation, quaternion xyzw, vertical and horizontal field of view
/// (radians).
pub fn encode(prior: &Prior) -> [f64; 9] {
    let [width, height, fx, fy, ..] = prior.camera;
    let (r, center) = (|row: usize, column: usize| prior.pose[3 * row + column], &prior.pose[9..]);
    let inverse = [[r(0, 0), r(1, 0), r(2, 0)], [r(0, 1), r(1, 1), r(2, 1)], [r(0, 2), r(1, 2), r(2, 2)]];
    let [tx, ty, tz] = inverse.map(|row| -(row[0] * center[0] + row[1] * center[1] + row[2] * center[2]));
    let [w, x, y, z] = quat_from_rotation(inverse);
    [tx, ty, tz, x, y, z, w, 2.0 * (height / (2.0 * fy)).atan(), 2.0 * (width / (2.0 * fx)).atan()]
}

/// Converts a rotation matrix to a unit quaternion wxyz, w >= 0 (Shepperd 1978).
pub fn quat_from_rotation(m: [[f64; 3]; 3]) -> [f64; 4] {
    // Row i: the quaternion times 4 times its component i.
    let [diagonal, skew, symmetric] = [
        [m[0][0], m[1][1], m[2][2]],
        [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]],
        [m[2][1] + m[1][2], m[0][2] + m[2][0], m[1][0] + m[0][1]],
    ];
    let [a, b, c] = diagonal;
    let rows = [
        [1.0 + a + b + c, skew[0], skew[1], skew[2]],
        [skew[0], 1.0 + a - b - c, symmetric[2], symmetric[1]],
        [skew[1], symmetric[2], 1.0 - a + b - c, symmetric[0]],
        [skew[2], symmetric[1], symmetric[0], 1.0 - a - b + c],
    ];
    let largest = (0..4).max_by(|&i, &j| rows[i][i].total_cmp(&rows[j][j]).then(j.cmp(&i))).expect("four rows");
    let length = 2.0 * rows[largest][largest].sqrt();
    let sign = if rows[largest][0] < 0.0 { -1.0 } else { 1.0 };
    rows[largest].map(|component| sign * component / length)
}
