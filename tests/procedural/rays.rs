//! Hits in f64, by other algorithms: single faces, quadratics, bisection, all triangles.

use zipsplat_cli::procedural::{HeightField, Primitive, Shape};
use zipsplat_tests::prelude::*;

/// For a torus's roots.
const STEPS: usize = 4000;

pub fn nearest(primitives: &[Primitive], origin: DVec3, direction: DVec3) -> Option<f64> {
    primitives.iter().filter_map(|primitive| intersect(primitive, origin, direction)).min_by(f64::total_cmp)
}

fn intersect(primitive: &Primitive, origin: DVec3, direction: DVec3) -> Option<f64> {
    let axes = primitive.rotation;
    let world_from_local = DMat3::from_cols(axes.x_axis.as_dvec3(), axes.y_axis.as_dvec3(), axes.z_axis.as_dvec3());
    let local_from_world = world_from_local.inverse();
    let (o, d) = (local_from_world * (origin - primitive.center.as_dvec3()), local_from_world * direction);
    let candidates = match &primitive.shape {
        Shape::Box { half } => faces(o, d, half.as_dvec3()),
        Shape::Ellipsoid { radii } => {
            let (o, d) = (o / radii.as_dvec3(), d / radii.as_dvec3());
            quadratic(d.dot(d), 2.0 * o.dot(d), o.dot(o) - 1.0)
        }
        Shape::Cylinder { radius, half_height } => cylinder(o, d, f64::from(*radius), f64::from(*half_height)),
        Shape::Torus { major, minor } => torus(o, d, f64::from(*major), f64::from(*minor)),
        Shape::Rectangle { half } => {
            let t = -o.z / d.z;
            let p = o + d * t;
            let inside = p.x.abs() <= f64::from(half.x) && p.y.abs() <= f64::from(half.y);
            if inside { vec![t] } else { Vec::new() }
        }
        Shape::HeightField(field) => triangles(field, o, d),
    };
    candidates.into_iter().filter(|t| *t > 0.0).min_by(f64::total_cmp)
}

fn faces(o: DVec3, d: DVec3, half: DVec3) -> Vec<f64> {
    let mut hits = Vec::new();
    for axis in 0..3 {
        for side in [-half[axis], half[axis]] {
            let t = (side - o[axis]) / d[axis];
            let p = o + d * t;
            if (0..3).all(|other| other == axis || p[other].abs() <= half[other]) {
                hits.push(t);
            }
        }
    }
    hits
}

fn quadratic(a: f64, b: f64, c: f64) -> Vec<f64> {
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return Vec::new();
    }
    let root = discriminant.sqrt();
    vec![(-b - root) / (2.0 * a), (-b + root) / (2.0 * a)]
}

fn cylinder(o: DVec3, d: DVec3, radius: f64, half_height: f64) -> Vec<f64> {
    let side = quadratic(d.x * d.x + d.y * d.y, 2.0 * (o.x * d.x + o.y * d.y), o.x * o.x + o.y * o.y - radius * radius);
    let mut hits: Vec<f64> = side.into_iter().filter(|t| (o.z + d.z * t).abs() <= half_height).collect();
    for cap in [-half_height, half_height] {
        let t = (cap - o.z) / d.z;
        let p = o + d * t;
        if p.x.hypot(p.y) <= radius {
            hits.push(t);
        }
    }
    hits
}

/// First root of `(|p|² + R² - r²)² - 4 R² (x² + y²)`, by steps and bisection.
fn torus(o: DVec3, d: DVec3, major: f64, minor: f64) -> Vec<f64> {
    let value = |t: f64| {
        let p = o + d * t;
        (p.length_squared() + major * major - minor * minor).powi(2) - 4.0 * major * major * (p.x * p.x + p.y * p.y)
    };
    let (middle, reach) = (-o.dot(d), major + minor);
    let step = 2.0 * reach / STEPS as f64;
    let at = |k: usize| (middle - reach + step * k as f64).max(0.0);
    let Some(k) = (0..STEPS).find(|k| value(at(*k)) > 0.0 && value(at(k + 1)) <= 0.0) else { return Vec::new() };
    let (mut low, mut high) = (at(k), at(k + 1));
    for _ in 0..60 {
        let half = 0.5 * (low + high);
        if value(half) > 0.0 { low = half } else { high = half }
    }
    vec![high]
}

/// Möller-Trumbore.
fn triangles(field: &HeightField, o: DVec3, d: DVec3) -> Vec<f64> {
    let corner = |i: usize, j: usize| field.corner(i, j).as_dvec3();
    let cells = (0..field.cells()).flat_map(|j| (0..field.cells()).map(move |i| (i, j)));
    let both = cells.flat_map(|(i, j)| {
        let (low, high) = (corner(i, j), corner(i + 1, j + 1));
        [[low, corner(i + 1, j), high], [low, high, corner(i, j + 1)]]
    });
    let hit = |[a, b, c]: [DVec3; 3]| {
        let (e1, e2) = (b - a, c - a);
        let p = d.cross(e2);
        let scale = 1.0 / e1.dot(p);
        let s = o - a;
        let u = s.dot(p) * scale;
        let q = s.cross(e1);
        let v = d.dot(q) * scale;
        (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then(|| e2.dot(q) * scale)
    };
    both.filter_map(hit).collect()
}
