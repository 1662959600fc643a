//! Ray intersections in local coordinates.

use std::sync::Arc;

use glam::{Mat3A, Vec2, Vec3A, Vec3Swizzles};

use super::height_field::{HeightField, slab};
use super::material::Material;

/// For rays that graze a torus.
const TORUS_STEPS: usize = 96;

/// Surface around the origin; lengths in meters.
#[derive(Clone)]
pub enum Shape {
    /// All `|x_i| <= half_i`.
    Box { half: Vec3A },
    /// `|x / radii| <= 1`.
    Ellipsoid { radii: Vec3A },
    /// Around z, with two end discs.
    Cylinder {
        radius: f32,
        /// Half the distance between the discs.
        half_height: f32,
    },
    /// Around z.
    Torus {
        /// Radius of the tube's center circle.
        major: f32,
        /// Radius of the tube.
        minor: f32,
    },
    /// In the plane z = 0, two-sided.
    Rectangle { half: Vec2 },
    /// Triangles over a grid in x and y.
    HeightField(Arc<HeightField>),
}

#[derive(Clone)]
pub struct Primitive {
    pub shape: Shape,
    /// World from local axes.
    pub rotation: Mat3A,
    pub center: Vec3A,
    pub(super) to_local: Mat3A,
    pub(super) material: Material,
}

impl Primitive {
    /// First distance in (0, `limit`) along a unit direction.
    pub(super) fn intersect(&self, origin: Vec3A, direction: Vec3A, limit: f32) -> Option<f32> {
        let t = self.shape.intersect(self.to_local * (origin - self.center), self.to_local * direction, limit)?;
        (t > 0.0 && t < limit).then_some(t)
    }

    /// Half sides, along the world's axes.
    pub(super) fn extent(&self) -> Vec3A {
        let half = match &self.shape {
            Shape::Box { half } => *half,
            Shape::Ellipsoid { radii } => *radii,
            Shape::Cylinder { radius, half_height } => Vec3A::new(*radius, *radius, *half_height),
            Shape::Torus { major, minor } => Vec3A::new(major + minor, major + minor, *minor),
            Shape::Rectangle { half } => Vec3A::new(half.x, half.y, 0.0),
            Shape::HeightField(field) => field.extent(),
        };
        let Mat3A { x_axis, y_axis, z_axis } = self.rotation;
        x_axis.abs() * half.x + y_axis.abs() * half.y + z_axis.abs() * half.z
    }
}

impl Shape {
    fn intersect(&self, origin: Vec3A, direction: Vec3A, limit: f32) -> Option<f32> {
        match self {
            Self::Box { half } => nearer(slab(origin, direction, *half)),
            Self::Ellipsoid { radii } => nearer(sphere(origin / *radii, direction / *radii)),
            Self::Cylinder { radius, half_height } => nearer(cylinder(origin, direction, *radius, *half_height)),
            Self::Torus { major, minor } => torus(origin, direction, *major, *minor, limit),
            Self::Rectangle { half } => {
                let t = -origin.z / direction.z;
                let inside = (origin + direction * t).xy().abs().cmple(*half).all();
                (inside && t.is_finite()).then_some(t)
            }
            Self::HeightField(field) => field.intersect(origin, direction, limit),
        }
    }

    /// Inside a solid or under a height field.
    pub(super) fn contains(&self, p: Vec3A) -> bool {
        match self {
            Self::Box { half } => p.abs().cmple(*half).all(),
            Self::Ellipsoid { radii } => (p / *radii).length_squared() <= 1.0,
            Self::Cylinder { radius, half_height } => p.xy().length() <= *radius && p.z.abs() <= *half_height,
            Self::Torus { major, minor } => torus_distance(p, *major, *minor) <= 0.0,
            Self::Rectangle { .. } => false,
            Self::HeightField(field) => field.height(p.xy()).is_some_and(|height| p.z <= height),
        }
    }

    /// Outward, at a local surface point.
    pub(super) fn normal(&self, p: Vec3A) -> Vec3A {
        match self {
            Self::Box { half } => axis_of(p / *half),
            Self::Ellipsoid { radii } => (p / (*radii * *radii)).normalize_or(Vec3A::Z),
            Self::Cylinder { radius, half_height } => {
                let side = p.xy().length() / radius;
                if side < (p.z / half_height).abs() {
                    Vec3A::Z * p.z.signum()
                } else {
                    Vec3A::new(p.x, p.y, 0.0).normalize_or(Vec3A::X)
                }
            }
            Self::Torus { major, .. } => torus_gradient(p, *major),
            Self::Rectangle { .. } => Vec3A::Z,
            Self::HeightField(field) => field.normal(p.xy()),
        }
    }

    /// In meters: unrolled on cylinders, else on the nearest box face.
    pub(super) fn surface_coordinates(&self, p: Vec3A, normal: Vec3A) -> Vec2 {
        match self {
            Self::Cylinder { radius, .. } if normal.z.abs() < 0.5 => Vec2::new(p.y.atan2(p.x) * radius, p.z),
            Self::Torus { major, minor } => {
                let ring = p.xy().length() - major;
                Vec2::new(p.y.atan2(p.x) * major, p.z.atan2(ring) * minor)
            }
            Self::Rectangle { .. } | Self::HeightField(_) => p.xy(),
            _ => match axis_of(normal).abs() {
                axis if axis.x > 0.5 => Vec2::new(p.y, p.z),
                axis if axis.y > 0.5 => Vec2::new(p.x, p.z),
                _ => p.xy(),
            },
        }
    }
}

fn axis_of(v: Vec3A) -> Vec3A {
    let size = v.abs();
    if size.x >= size.y && size.x >= size.z {
        Vec3A::X * v.x.signum()
    } else if size.y >= size.z {
        Vec3A::Y * v.y.signum()
    } else {
        Vec3A::Z * v.z.signum()
    }
}

/// First positive end.
fn nearer(interval: Option<[f32; 2]>) -> Option<f32> {
    interval.map(|[enter, leave]| if enter > 0.0 { enter } else { leave })
}

/// Starts at the ray's closest point: no cancellation for distant origins.
fn sphere(origin: Vec3A, direction: Vec3A) -> Option<[f32; 2]> {
    let a = direction.length_squared();
    let middle = -origin.dot(direction) / a;
    let left = 1.0 - (origin + direction * middle).length_squared();
    let half = (left / a).sqrt();
    (left >= 0.0).then_some([middle - half, middle + half])
}

fn cylinder(origin: Vec3A, direction: Vec3A, radius: f32, half_height: f32) -> Option<[f32; 2]> {
    let (o, d) = (origin.xy(), direction.xy());
    let a = d.length_squared().max(1e-12);
    let middle = -o.dot(d) / a;
    let left = radius * radius - (o + d * middle).length_squared();
    if left < 0.0 {
        return None;
    }
    let half = (left / a).sqrt();
    let (below, above) = ((-half_height - origin.z) / direction.z, (half_height - origin.z) / direction.z);
    let enter = (middle - half).max(below.min(above));
    let leave = (middle + half).min(below.max(above));
    (enter <= leave).then_some([enter, leave])
}

fn torus_distance(p: Vec3A, major: f32, minor: f32) -> f32 {
    Vec2::new(p.xy().length() - major, p.z).length() - minor
}

fn torus_gradient(p: Vec3A, major: f32) -> Vec3A {
    let ring = Vec3A::new(p.x, p.y, 0.0).normalize_or(Vec3A::X) * major;
    (p - ring).normalize_or(Vec3A::Z)
}

/// Traces spheres (Hart 1996) in the bounding cylinder, then takes Newton steps: quartic roots are
/// imprecise in f32.
fn torus(origin: Vec3A, direction: Vec3A, major: f32, minor: f32, limit: f32) -> Option<f32> {
    let [enter, leave] = cylinder(origin, direction, major + minor, minor)?;
    let end = leave.min(limit);
    let mut t = enter.max(0.0);
    for _ in 0..TORUS_STEPS {
        if t > end {
            return None;
        }
        let distance = torus_distance(origin + direction * t, major, minor);
        if distance < 1e-4 * minor {
            break;
        }
        t += distance;
    }
    for _ in 0..2 {
        let p = origin + direction * t;
        let slope = torus_gradient(p, major).dot(direction);
        if slope > -0.05 {
            break;
        }
        t -= torus_distance(p, major, minor) / slope;
    }
    Some(t)
}
