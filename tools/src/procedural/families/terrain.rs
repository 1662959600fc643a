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

const CELLS: usize = 96;

pub(super) fn build(b: &mut Builder) -> Setting {
    let half_side = b.rng.range(18.0, 40.0);
    let (relief, hill) = (b.rng.range(1.0, 9.0), b.rng.range(8.0, 20.0));
    let offset = 100.0 * Vec2::new(b.rng.unit(), b.rng.unit());
    let height = |p: Vec2| relief * (fbm(Vec3A::from(((p + offset) / hill).extend(0.0)), 4, 0.0) - 0.5) * 2.0;
    let field = Arc::new(HeightField::new(half_side, CELLS, height));
    b.palette.detail = b.rng.scale(0.8, 2.5);
    let (cover, plain) = (b.palette.terrain(&mut b.rng), b.draw(Role::Ground));
    b.put(Shape::HeightField(field.clone()), Vec3A::ZERO, Mat3A::IDENTITY, cover);
    // Water or a plain, in deep valleys and beyond the hills.
    b.rectangle(Vec3A::Z * (-0.45 * relief), [400.0; 2], Vec3A::Z, plain);

    let radius = b.rng.range(6.0, 0.55 * half_side);
    let count = b.rng.count(5, 24);
    for place in scatter(&mut b.rng, count, radius, 2.0) {
        let ground = field.height(place).unwrap_or(0.0).max(-0.45 * relief);
        plant(b, Vec3A::from(place.extend(ground)));
        if b.primitives.len() > 50 {
            break;
        }
    }
    b.primitives.truncate(60);

    let (light, sky) = daylight(&mut b.rng);
    let aerial = b.rng.chance(0.6);
    let reach = if aerial { b.rng.range(10.0, 22.0) } else { b.rng.range(6.0, 12.0) };
    let target = 0.3 * radius * Vec2::new(b.rng.signed(), b.rng.signed());
    let stage = Stage {
        target: Vec3A::from(target.extend(field.height(target).unwrap_or(0.0) + if aerial { 0.0 } else { 1.0 })),
        distance: [0.8 * reach, 1.2 * reach],
        elevation: if aerial { [0.4, 1.1] } else { [0.1, 0.35] },
        front: b.rng.angle(),
        freedom: PI,
        bounds: [Vec3A::splat(-half_side), Vec3A::splat(half_side)],
        paths: &PathKind::ALL_AROUND,
    };
    Setting { light, sky, room: None, stage }
}

fn plant(b: &mut Builder, place: Vec3A) {
    let heading = b.rng.angle();
    match b.rng.count(0, 6) {
        0..=2 => {
            let height = b.rng.range(2.0, 5.0);
            b.tree(place, height);
        }
        3 => {
            let size = b.rng.range(2.5, 5.0);
            b.house(place, size, heading);
        }
        4 => {
            let bush = b.draw(Role::Foliage);
            let (radius, flat) = (b.rng.range(0.4, 1.2), b.rng.range(0.7, 1.0));
            b.ball(place + Vec3A::Z * (0.4 * radius), [radius, radius * flat, 0.8 * radius], bush);
        }
        5 => {
            let rock = b.draw(Role::Stone);
            let (radius, flat) = (b.rng.range(0.3, 1.4), b.rng.range(0.5, 0.9));
            b.ball(place, [radius, radius * flat, 0.8 * radius], rock);
        }
        _ => {
            let size = b.rng.range(0.8, 2.5);
            b.solid(place - Vec3A::Z * 0.1, size);
        }
    }
}
