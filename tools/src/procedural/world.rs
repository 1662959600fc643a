//! Primitives, light and sky, and the color along a ray.

use glam::{Vec3A, Vec3Swizzles};

use super::bvh::Bvh;
use super::material::Material;
use super::noise::{fbm, smoothstep};
use super::photos::Photos;
use super::shape::{Primitive, Shape};
use super::texture::Place;

/// Largest distance of a ray, in meters.
const FAR: f32 = 1e4;

/// Shadow-casting.
#[derive(Clone, Copy, Debug)]
pub(super) enum Key {
    /// Direction toward the sun.
    Sun(Vec3A),
    /// Position, and reference distance in meters of its light.
    Lamp(Vec3A, f32),
}

#[derive(Clone, Debug)]
pub(super) struct Light {
    pub key: Key,
    pub color: Vec3A,
    /// From above and from below.
    pub ambient: [Vec3A; 2],
}

#[derive(Clone, Debug)]
pub(super) struct Sky {
    pub zenith: Vec3A,
    pub horizon: Vec3A,
    pub clouds: f32,
    pub offset: Vec3A,
    /// Meters that hide two thirds of a surface.
    pub haze: f32,
}

/// Corners get less ambient light.
#[derive(Clone, Copy, Debug)]
pub(super) struct Room {
    pub low: Vec3A,
    pub high: Vec3A,
}

/// Scene in meters, z up.
pub struct World {
    primitives: Vec<Primitive>,
    bvh: Bvh,
    light: Light,
    sky: Sky,
    room: Option<Room>,
}

pub(super) struct Hit {
    pub light: Vec3A,
    /// Distance to the surface; `None` in the sky.
    pub distance: Option<f32>,
    /// Primitive in the high 28 bits, then face and shadow. Neighbors that differ are an edge for
    /// antialiasing.
    pub region: u32,
}

impl World {
    pub(super) fn new(primitives: Vec<Primitive>, light: Light, sky: Sky, room: Option<Room>) -> Self {
        Self { bvh: Bvh::new(&primitives), primitives, light, sky, room }
    }

    pub fn primitives(&self) -> &[Primitive] {
        &self.primitives
    }

    /// Distance in meters along a unit direction.
    pub fn distance(&self, origin: Vec3A, direction: Vec3A) -> Option<f32> {
        self.bvh.nearest(&self.primitives, origin, direction, FAR).map(|(t, _)| t)
    }

    pub fn contains(&self, point: Vec3A) -> bool {
        self.primitives.iter().any(|p| p.shape.contains(p.to_local * (point - p.center)))
    }

    /// Returns true for a surface in between, except within `slack` meters of the second point.
    pub(super) fn blocked(&self, from: Vec3A, to: Vec3A, slack: f32) -> bool {
        let length = (to - from).length();
        self.bvh.occluded(&self.primitives, from, (to - from) / length, length - slack)
    }

    /// `pixel`: angle of a pixel.
    pub(super) fn trace(&self, origin: Vec3A, direction: Vec3A, pixel: f32, photos: &Photos) -> Hit {
        let Some((t, index)) = self.bvh.nearest(&self.primitives, origin, direction, FAR) else {
            return Hit { light: self.sky.color(direction), distance: None, region: u32::MAX };
        };
        let primitive = &self.primitives[index];
        let point = origin + direction * t;
        let local = primitive.to_local * (point - primitive.center);
        let local_normal = primitive.shape.normal(local);
        let outward = primitive.rotation * local_normal;
        let facing = -outward.dot(direction);
        let normal = if facing < 0.0 { -outward } else { outward };
        let place = Place {
            position: local,
            normal: local_normal,
            uv: primitive.shape.surface_coordinates(local, local_normal),
            footprint: t * pixel / facing.abs().max(0.1).sqrt(),
        };
        let albedo = primitive.material.texture.color(&place, photos);
        let surface = Surface { point, normal, direction, material: &primitive.material, reach: 2e-4 + 2e-4 * t };
        let (light, lit) = self.shade(&surface, albedo);
        let haze = 1.0 - (-t / self.sky.haze).exp();
        let light = light.lerp(self.sky.horizon, haze);
        let face =
            if matches!(primitive.shape, Shape::Box { .. } | Shape::Cylinder { .. }) { face(local_normal) } else { 0 };
        Hit { light, distance: Some(t), region: (index as u32) << 4 | face << 1 | u32::from(lit) }
    }

    /// Lambert and Blinn-Phong, and the visibility of the key light by one shadow ray.
    fn shade(&self, surface: &Surface, albedo: Vec3A) -> (Vec3A, bool) {
        let Surface { point, normal, direction, material, reach } = *surface;
        let [above, below] = self.light.ambient;
        let ambient = below.lerp(above, 0.5 + 0.5 * normal.z) * self.corner_shade(point, normal);
        let (to_light, distance, falloff) = match self.light.key {
            Key::Sun(towards) => (towards, FAR, 1.0),
            Key::Lamp(position, reference) => {
                let offset = position - point;
                let squared = offset.length_squared();
                let near = reference * reference;
                (offset / squared.sqrt(), squared.sqrt(), 1.3 * near / (squared + 0.3 * near))
            }
        };
        let cosine = normal.dot(to_light);
        let start = point + normal * reach;
        let lit = cosine > 0.0 && !self.bvh.occluded(&self.primitives, start, to_light, distance - 2.0 * reach);
        let mut light = albedo * (ambient + material.glow);
        if lit {
            let half = (to_light - direction).normalize_or(normal);
            let highlight = match material.specular {
                0.0 => 0.0,
                strength => strength * normal.dot(half).max(0.0).powf(material.shininess),
            };
            light += self.light.color * falloff * cosine * (albedo + highlight);
        }
        (light, lit)
    }

    fn corner_shade(&self, point: Vec3A, normal: Vec3A) -> f32 {
        let Some(Room { low, high }) = self.room else { return 1.0 };
        let gaps = (point - low).min(high - point).max(Vec3A::ZERO);
        let side = |axis: usize| {
            let gap = gaps[axis];
            1.0 - 0.45 * (1.0 - normal[axis].abs()) * (-gap / 0.35).exp()
        };
        side(0) * side(1) * side(2)
    }
}

struct Surface<'a> {
    point: Vec3A,
    normal: Vec3A,
    direction: Vec3A,
    material: &'a Material,
    reach: f32,
}

fn face(normal: Vec3A) -> u32 {
    let size = normal.abs();
    let axis = if size.z > 0.9 { 2 } else { u32::from(size.y > size.x) };
    2 * axis + u32::from(normal[axis as usize] > 0.0)
}

impl Sky {
    fn color(&self, direction: Vec3A) -> Vec3A {
        let up = direction.z;
        let clear = self.horizon.lerp(self.zenith, smoothstep(-0.05, 0.6, up));
        if up <= 0.0 || self.clouds <= 0.0 {
            return clear;
        }
        let plane = (direction.xy() / (up + 0.15)).extend(0.0);
        let cover = fbm(Vec3A::from(plane) * 1.5 + self.offset, 4, 0.02);
        let cloud = smoothstep(0.75 - 0.6 * self.clouds, 1.0 - 0.5 * self.clouds, cover) * smoothstep(0.0, 0.15, up);
        clear.lerp(Vec3A::splat(1.1 * self.horizon.max_element()), cloud)
    }
}
