use std::f32::consts::PI;
use std::sync::Arc;

use glam::{Mat3A, Vec2, Vec3A};

use super::{Setting, daylight, scatter};
use crate::procedural::builder::Builder;
use crate::procedural::height_field::HeightField;
use crate::procedural::material::Role;
use crate::procedural::noise::fbm;
use crate::procedural::path::{PathKind, Stage};
use crate::procedural::shape::Shape;

pub(super) fn build(b: &mut Builder) -> Setting {
    b.palette.detail = b.rng.scale(0.3, 1.2);
    b.palette.photo_share = b.rng.range(0.1, 0.8);
    let ground = b.draw(Role::Ground);
    if b.rng.chance(0.3) {
        let (relief, offset) = (b.rng.range(0.1, 0.5), 50.0 * Vec2::new(b.rng.unit(), b.rng.unit()));
        let height = |p: Vec2| relief * (fbm(Vec3A::from((p / 2.0 + offset).extend(0.0)), 4, 0.0) - 0.5);
        b.put(Shape::HeightField(Arc::new(HeightField::new(12.0, 80, height))), Vec3A::ZERO, Mat3A::IDENTITY, ground);
    } else {
        b.rectangle(Vec3A::ZERO, [40.0; 2], Vec3A::Z, ground);
    }
    let radius = b.rng.range(1.0, 2.2);
    let walls = b.rng.count(0, 3);
    let turn = b.rng.angle();
    for i in 0..walls {
        let towards = Vec3A::from(Vec2::from_angle(turn + 0.5 * PI * i as f32).extend(0.0));
        let (wall, gap, tall) = (b.draw(Role::Facade), radius + b.rng.range(1.5, 3.0), b.rng.range(1.5, 4.0));
        let (heading, half_length) = (towards.y.atan2(towards.x), b.rng.range(2.0, 6.0));
        b.block(towards * gap + Vec3A::Z * (tall - 0.3), [0.1, half_length, tall], heading, wall);
    }

    let count = b.rng.count(4, 30);
    let typical = b.rng.range(0.35, 0.8);
    for place in scatter(&mut b.rng, count, radius, 0.5 * typical) {
        let base = Vec3A::from(place.extend(-0.02));
        let size = typical * b.rng.scale(0.5, 2.0);
        match b.rng.count(0, 8) {
            0 => tower(b, base, size),
            1 => rods(b, base, size),
            2 => b.thing(base, size),
            _ => b.solid(base, size),
        }
        if b.primitives.len() > 52 {
            break;
        }
    }
    b.primitives.truncate(60);

    let (light, sky) = daylight(&mut b.rng);
    let reach = radius * b.rng.range(1.3, 2.0) + 0.5;
    let stage = Stage {
        target: Vec3A::new(0.2 * b.rng.signed(), 0.2 * b.rng.signed(), b.rng.range(0.2, 0.6)),
        distance: [0.8 * reach, 1.2 * reach],
        elevation: [0.12, 0.8],
        front: turn + PI + if walls > 1 { 0.4 } else { 0.0 },
        freedom: if walls == 0 { PI } else { 1.1 },
        bounds: [Vec3A::new(-10.0, -10.0, 0.15), Vec3A::splat(10.0)],
        paths: &PathKind::ALL_AROUND,
    };
    Setting { light, sky, room: None, stage }
}

fn tower(b: &mut Builder, base: Vec3A, size: f32) {
    let mut height = 0.0;
    for i in 0..b.rng.count(2, 4) {
        let side = size * b.rng.range(0.25, 0.45) * 0.85f32.powi(i as i32);
        let (material, heading) = (b.draw(Role::Anything), b.rng.angle());
        let half = [side, side * b.rng.range(0.6, 1.0), side * b.rng.range(0.6, 1.2)];
        b.block(base + Vec3A::Z * (height + half[2]), half, heading, material);
        height += 2.0 * half[2];
    }
    if b.rng.chance(0.5) {
        let (top, material) = (0.2 * size, b.draw(Role::Anything));
        b.ball(base + Vec3A::Z * (height + top), [top; 3], material);
    }
}

fn rods(b: &mut Builder, base: Vec3A, size: f32) {
    let material = b.draw(Role::Metal);
    for _ in 0..b.rng.count(2, 5) {
        let from = base + 0.4 * size * Vec3A::new(b.rng.signed(), b.rng.signed(), 0.0);
        let to = from + size * Vec3A::new(0.5 * b.rng.signed(), 0.5 * b.rng.signed(), b.rng.range(0.8, 2.2));
        let radius = size * b.rng.range(0.015, 0.05);
        b.rod(from, to, radius, material);
    }
}
