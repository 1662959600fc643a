//! Pose from three points, up to four solutions.
//!
//! Point distances are intersections of two conics, found by a degenerate conic of their pencil
//! (Persson and Nordberg, Lambda Twist, ECCV 2018), split into lines as in Richter-Gebert,
//! Perspectives on Projective Geometry, 11.1.

use crate::types::Pose;
use glam::{DMat3, DVec3};

const TINY: f64 = 1e-12;
const POLISH: usize = 3;

/// Poses that see `points` in front along unit `bearings`.
pub fn poses(points: [DVec3; 3], bearings: [DVec3; 3]) -> Vec<Pose> {
    let [a12, a13, a23] = [(0, 1), (0, 2), (1, 2)].map(|(i, j): (usize, usize)| points[i].distance_squared(points[j]));
    let [b12, b13, b23] = [(0, 1), (0, 2), (1, 2)].map(|(i, j): (usize, usize)| bearings[i].dot(bearings[j]));
    // dᵀ m_ij d = a_ij for distances d.
    let m12 = symmetric([1.0, 1.0, 0.0], [-b12, 0.0, 0.0]);
    let m13 = symmetric([1.0, 0.0, 1.0], [0.0, -b13, 0.0]);
    let m23 = symmetric([0.0, 1.0, 1.0], [0.0, 0.0, -b23]);
    let scale = a12.max(a13).max(a23);
    let [a12, a13, a23] = [a12, a13, a23].map(|square| square / scale);
    let (first, second) = (m12 * a23 - m23 * a12, m13 * a23 - m23 * a13);
    let Some(lines) = lines(first, second) else { return Vec::new() };
    let mut poses = Vec::new();
    for line in lines {
        for ray in meets(line, first) {
            let squares = ray.dot(m23 * ray);
            let ray = if ray.x < 0.0 { -ray } else { ray };
            if squares > 0.0 && ray.min_element() > 0.0 {
                let distances = polished(ray * (a23 / squares).sqrt(), [m12, m13, m23], [a12, a13, a23]);
                poses.extend(pose(points, bearings, distances * scale.sqrt()));
            }
        }
    }
    poses
}

/// Diagonal, entries 12, 13, 23.
fn symmetric([xx, yy, zz]: [f64; 3], [xy, xz, yz]: [f64; 3]) -> DMat3 {
    DMat3::from_cols_array(&[xx, xy, xz, xy, yy, yz, xz, yz, zz])
}

fn lines(first: DMat3, second: DMat3) -> Option<[DVec3; 2]> {
    let ([a, b, c], [p, q, r]) = (columns(first), columns(second));
    let det = |x: DVec3, y: DVec3, z: DVec3| x.dot(y.cross(z));
    // det(first + g second), by powers of g.
    let cubic = [
        det(a, b, c),
        det(p, b, c) + det(a, q, c) + det(a, b, r),
        det(a, q, r) + det(p, b, r) + det(p, q, c),
        det(p, q, r),
    ];
    // Farthest from a double line.
    let split = |g: f64| {
        let conic = first + second * g;
        let adjugate = adjugate(conic);
        let diagonal = [adjugate.x_axis.x, adjugate.y_axis.y, adjugate.z_axis.z];
        let (at, least) = diagonal.into_iter().enumerate().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let size = columns(conic).map(DVec3::length_squared).into_iter().fold(0.0, f64::max);
        (least < -TINY * size).then(|| (least / size, conic, columns(adjugate)[at] / (-least).sqrt()))
    };
    let (_, conic, p) = roots(cubic).into_iter().filter_map(split).min_by(|a, b| a.0.total_cmp(&b.0))?;
    let crossed = DMat3::from_cols(DVec3::new(0.0, p.z, -p.y), DVec3::new(-p.z, 0.0, p.x), DVec3::new(p.y, -p.x, 0.0));
    let product = conic + crossed;
    // Rank one: any nonzero column and row.
    let (cols, rows) = (columns(product), columns(product.transpose()));
    let longest = |of: [DVec3; 3]| of.into_iter().max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
    Some([longest(cols)?.normalize_or_zero(), longest(rows)?.normalize_or_zero()])
}

fn columns(m: DMat3) -> [DVec3; 3] {
    [m.x_axis, m.y_axis, m.z_axis]
}

fn adjugate(m: DMat3) -> DMat3 {
    let [a, b, c] = columns(m);
    DMat3::from_cols(b.cross(c), c.cross(a), a.cross(b))
}

/// Real roots up to degree 3, coefficients ascending.
fn roots([c0, c1, c2, c3]: [f64; 4]) -> Vec<f64> {
    let most = c0.abs().max(c1.abs()).max(c2.abs()).max(c3.abs());
    if c3.abs() <= TINY * most {
        return quadratic_roots([c0, c1, c2]);
    }
    let (a, b, c) = (c2 / c3, c1 / c3, c0 / c3);
    // t^3 + 3 p t + 2 q with x = t - a / 3.
    let (p, q) = (b / 3.0 - a * a / 9.0, a * a * a / 27.0 - a * b / 6.0 + c / 2.0);
    let discriminant = q * q + p * p * p;
    let depressed = if discriminant > 0.0 {
        let u = -(q + q.signum() * discriminant.sqrt());
        let u = u.cbrt();
        vec![if u == 0.0 { 0.0 } else { u - p / u }]
    } else {
        let (radius, angle) =
            ((-p).max(0.0).sqrt(), (-q / (-p).max(f64::MIN_POSITIVE).powf(1.5)).clamp(-1.0, 1.0).acos());
        (0..3).map(|k| 2.0 * radius * ((angle + std::f64::consts::TAU * f64::from(k)) / 3.0).cos()).collect()
    };
    let newton = |x: f64| {
        let slope = (3.0 * x + 2.0 * a) * x + b;
        if slope == 0.0 { x } else { x - (((x + a) * x + b) * x + c) / slope }
    };
    depressed.into_iter().map(|t| (0..POLISH).fold(t - a / 3.0, |x, _| newton(x))).collect()
}

/// Real roots of `c0 + c1 x + c2 x^2`.
fn quadratic_roots([c0, c1, c2]: [f64; 3]) -> Vec<f64> {
    let discriminant = c1 * c1 - 4.0 * c0 * c2;
    if discriminant < 0.0 {
        return Vec::new();
    }
    // Avoids cancellation.
    let half = -(c1 + c1.signum() * discriminant.sqrt()) / 2.0;
    let roots = [half / c2, c0 / half];
    roots.into_iter().filter(|root| root.is_finite()).collect()
}

fn meets(line: DVec3, conic: DMat3) -> Vec<DVec3> {
    let (u, v) = line.any_orthonormal_pair();
    let products = [u.dot(conic * u), 2.0 * u.dot(conic * v), v.dot(conic * v)];
    quadratic_roots(products).into_iter().map(|t| u + t * v).collect()
}

fn polished(mut distances: DVec3, conics: [DMat3; 3], squares: [f64; 3]) -> DVec3 {
    for _ in 0..POLISH {
        let along = conics.map(|conic| conic * distances);
        let wrong = DVec3::from_array([0, 1, 2].map(|i| distances.dot(along[i]) - squares[i]));
        let slopes = DMat3::from_cols_array_2d(&along.map(|row| (2.0 * row).to_array())).transpose();
        let step = slopes.inverse() * wrong;
        if !step.is_finite() {
            break;
        }
        distances -= step;
    }
    distances
}

fn pose(points: [DVec3; 3], bearings: [DVec3; 3], distances: DVec3) -> Option<Pose> {
    let seen = [0, 1, 2].map(|i| bearings[i] * distances[i]);
    let [world, camera] = [points, seen].map(|[a, b, c]| DMat3::from_cols(b - a, c - a, (b - a).cross(c - a)));
    let turn = camera * world.inverse();
    if !turn.is_finite() {
        return None;
    }
    let x = turn.x_axis.normalize();
    let y = (turn.y_axis - x * x.dot(turn.y_axis)).normalize();
    let rotation = DMat3::from_cols(x, y, x.cross(y)).transpose();
    Some(Pose { rotation, translation: points[0] - rotation * seen[0] })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use glam::{DQuat, EulerRot};

    #[test]
    fn the_pose_is_among_those_of_three_points() {
        let mut random = Random::new(5);
        let mut found = 0;
        for _ in 0..2000 {
            let mut number = |range: f64| range * (2.0 * random.unit() - 1.0);
            let rotation = DMat3::from_quat(DQuat::from_euler(EulerRot::XYZ, number(3.0), number(1.5), number(3.0)));
            let pose = Pose { rotation, translation: DVec3::new(number(5.0), number(5.0), number(5.0)) };
            let seen = [0; 3].map(|_| DVec3::new(number(1.0), number(1.0), 3.0 + number(2.0)));
            let points = seen.map(|at| pose.transform(at));
            let poses = poses(points, seen.map(DVec3::normalize));
            assert!(poses.len() <= 4);
            let right = |other: &Pose| {
                other.translation.abs_diff_eq(pose.translation, 1e-6) && other.rotation.abs_diff_eq(pose.rotation, 1e-6)
            };
            found += usize::from(poses.iter().any(right));
            for other in &poses {
                for (point, at) in points.iter().zip(&seen) {
                    let along = other.inverse().transform(*point).normalize();
                    assert!(along.abs_diff_eq(at.normalize(), 1e-6), "{along} and {at}");
                }
            }
        }
        assert!(found >= 1995, "{found} of 2000");
    }

    #[test]
    fn points_of_no_camera_have_none() {
        let bearings = [DVec3::Z, DVec3::new(0.1, 0.0, 1.0).normalize(), DVec3::new(0.0, 0.1, 1.0).normalize()];
        assert!(poses([DVec3::ZERO; 3], bearings).is_empty());
        assert!(poses([DVec3::ZERO, DVec3::X, 2.0 * DVec3::X], bearings).is_empty());
    }
}
