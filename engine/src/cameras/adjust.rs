//! Levenberg-Marquardt on the reprojection error, with Cauchy's loss.

use super::Correspondence;
use crate::types::{Camera, Pose};
use glam::{DMat3, DQuat, DVec2, DVec3};

const STEPS: usize = 50;
const TOLERANCE: f64 = 1e-12;
const MOST_DAMPING: f64 = 1e12;
const UNKNOWNS: usize = 7;

type Vector = [f64; UNKNOWNS];
type Matrix = [Vector; UNKNOWNS];

pub fn adjusted(camera: &Camera, pairs: &[Correspondence], scale: f64, lens: bool) -> Camera {
    let (mut best, mut loss, mut damping) = (*camera, loss(camera, pairs, scale), 1e-3);
    for _ in 0..STEPS {
        let (matrix, gradient) = normal_equations(&best, pairs, scale, lens);
        let mut gained = None;
        while gained.is_none() && damping < MOST_DAMPING {
            let mut damped = matrix;
            (0..UNKNOWNS).for_each(|i| damped[i][i] += damping * matrix[i][i].max(f64::MIN_POSITIVE));
            let moved = solved(damped, gradient).map(|step| moved(&best, step));
            let next = moved.map(|camera| (camera, self::loss(&camera, pairs, scale)));
            match next.filter(|(_, next)| *next < loss) {
                Some((camera, next)) => {
                    gained = Some(loss - next);
                    (best, loss, damping) = (camera, next, (damping / 10.0).max(1e-12));
                }
                None => damping *= 10.0,
            }
        }
        if gained.is_none_or(|gained| gained <= TOLERANCE * loss) {
            break;
        }
    }
    best
}

/// Reprojection error in pixels, `None` behind the camera.
pub fn error(camera: &Camera, pair: &Correspondence) -> Option<DVec2> {
    let (lens, at) = (&camera.intrinsics, camera.pose.rotation.transpose() * (pair.point - camera.pose.translation));
    let pixel = DVec2::new(lens.fx * at.x / at.z + lens.cx, lens.fy * at.y / at.z + lens.cy);
    (at.z > 0.0 && pixel.is_finite()).then(|| pixel - pair.pixel)
}

/// Points behind the camera count as outliers.
fn loss(camera: &Camera, pairs: &[Correspondence], scale: f64) -> f64 {
    const BEHIND: f64 = 1e6;
    let square = |pair: &Correspondence| {
        error(camera, pair).map_or(BEHIND, |e| (e.length_squared() / (scale * scale)).min(BEHIND))
    };
    pairs.iter().map(|pair| square(pair).ln_1p()).sum()
}

fn normal_equations(camera: &Camera, pairs: &[Correspondence], scale: f64, lens: bool) -> (Matrix, Vector) {
    let (mut matrix, mut gradient) = ([[0.0; UNKNOWNS]; UNKNOWNS], [0.0; UNKNOWNS]);
    for pair in pairs {
        let Some(wrong) = error(camera, pair) else { continue };
        let weight = 1.0 / (1.0 + wrong.length_squared() / (scale * scale));
        for (row, wrong) in slopes(camera, pair, lens).into_iter().zip(wrong.to_array()) {
            for i in 0..UNKNOWNS {
                gradient[i] -= weight * row[i] * wrong;
                for j in 0..UNKNOWNS {
                    matrix[i][j] += weight * row[i] * row[j];
                }
            }
        }
    }
    if !lens {
        matrix[UNKNOWNS - 1][UNKNOWNS - 1] = 1.0;
    }
    (matrix, gradient)
}

fn slopes(camera: &Camera, pair: &Correspondence, lens: bool) -> [Vector; 2] {
    let (intrinsics, axes) = (&camera.intrinsics, camera.pose.rotation.transpose());
    let at = axes * (pair.point - camera.pose.translation);
    let row = |focal: f64, along: DVec3, place: f64| {
        let by_point = focal / at.z * (along - DVec3::Z * place / at.z);
        let by_turn = by_point.cross(at);
        let by_focal = if lens { focal * place / at.z } else { 0.0 };
        [by_turn.x, by_turn.y, by_turn.z, -by_point.x, -by_point.y, -by_point.z, by_focal]
    };
    [row(intrinsics.fx, DVec3::X, at.x), row(intrinsics.fy, DVec3::Y, at.y)]
}

fn moved(camera: &Camera, [a, b, c, x, y, z, focal]: Vector) -> Camera {
    let turn = DQuat::from_scaled_axis(DVec3::new(a, b, c));
    let Pose { rotation, translation } = camera.pose;
    let rotated = DQuat::from_mat3(&rotation).normalize() * turn;
    let mut intrinsics = camera.intrinsics;
    (intrinsics.fx, intrinsics.fy) = (intrinsics.fx * focal.exp(), intrinsics.fy * focal.exp());
    let pose = Pose {
        rotation: DMat3::from_quat(rotated.normalize()),
        translation: translation + rotation * DVec3::new(x, y, z),
    };
    Camera { intrinsics, pose }
}

/// By Cholesky factorization; `None` if not positive definite.
fn solved(mut a: Matrix, mut b: Vector) -> Option<Vector> {
    for i in 0..UNKNOWNS {
        for j in 0..=i {
            let rest = a[i][j] - (0..j).map(|k| a[i][k] * a[j][k]).sum::<f64>();
            a[i][j] = if i == j { Some(rest.sqrt()).filter(|root| *root > 0.0)? } else { rest / a[j][j] };
        }
        b[i] = (b[i] - (0..i).map(|k| a[i][k] * b[k]).sum::<f64>()) / a[i][i];
    }
    for i in (0..UNKNOWNS).rev() {
        b[i] = (b[i] - (i + 1..UNKNOWNS).map(|k| a[k][i] * b[k]).sum::<f64>()) / a[i][i];
    }
    Some(b).filter(|b| b.iter().all(|value| value.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{random::Random, types::Intrinsics};

    #[test]
    fn slopes_are_those_of_differences() {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 52.0, cx: 31.0, cy: 25.0 };
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(0.3, -0.2, 0.5)));
        let camera = Camera { intrinsics, pose: Pose { rotation, translation: DVec3::new(1.0, 2.0, -0.5) } };
        let point = camera.pose.transform(DVec3::new(0.4, -0.3, 2.0));
        let pair = Correspondence { point, pixel: DVec2::new(30.0, 20.0) };
        let found = slopes(&camera, &pair, true);
        for i in 0..UNKNOWNS {
            let at = |step: f64| {
                let mut by = [0.0; UNKNOWNS];
                by[i] = step;
                error(&moved(&camera, by), &pair).expect("in front")
            };
            let slope = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((found[0][i] - slope.x).abs() < 1e-5 && (found[1][i] - slope.y).abs() < 1e-5, "{i}: {slope}");
        }
    }

    #[test]
    fn systems_are_solved() {
        let mut random = Random::new(2);
        let rows: Vec<Vector> = (0..12).map(|_| [0.0; UNKNOWNS].map(|_: f64| random.normal())).collect();
        let wanted = [0.0; UNKNOWNS].map(|_: f64| random.normal());
        let (mut a, mut b) = ([[0.0; UNKNOWNS]; UNKNOWNS], [0.0; UNKNOWNS]);
        for row in &rows {
            for i in 0..UNKNOWNS {
                (0..UNKNOWNS).for_each(|j| a[i][j] += row[i] * row[j]);
                b[i] += row[i] * row.iter().zip(&wanted).map(|(x, y)| x * y).sum::<f64>();
            }
        }
        let found = solved(a, b).expect("it is positive definite");
        assert!(found.iter().zip(&wanted).all(|(found, wanted)| (found - wanted).abs() < 1e-9), "{found:?}");
        assert!(solved([[0.0; UNKNOWNS]; UNKNOWNS], b).is_none());
    }
}
