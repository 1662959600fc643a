use std::f32::consts::PI;

use glam::{Vec3A, Vec3Swizzles};

use super::{Setting, daylight, hang, lamplight, scatter};
use crate::procedural::builder::Builder;
use crate::procedural::material::Role;
use crate::procedural::path::{PathKind, Stage};
use crate::procedural::world::Room;

pub(super) fn build(b: &mut Builder) -> Setting {
    let half = [b.rng.range(0.4, 0.9), b.rng.range(0.35, 0.7)];
    let height = b.rng.range(0.6, 0.8);
    b.palette.detail = b.rng.scale(0.4, 1.0);
    let indoors = b.rng.chance(0.7);
    let wide = Vec3A::new(b.rng.range(1.6, 3.0), b.rng.range(1.6, 3.0), 0.0);
    let (low, high) = (-wide, wide.with_z(b.rng.range(2.3, 3.0)));
    if indoors {
        b.shell(low, high);
        for normal in [Vec3A::X, Vec3A::Y, Vec3A::NEG_X, Vec3A::NEG_Y] {
            let side = if normal.x == 0.0 { wide.x } else { wide.y };
            if b.rng.chance(0.6) {
                hang(b, -normal * wide, normal, side - 0.2, high.z);
            }
        }
    } else {
        let ground = b.draw(Role::Ground);
        b.rectangle(Vec3A::ZERO, [30.0; 2], Vec3A::Z, ground);
    }
    if b.rng.chance(0.6) {
        b.table(Vec3A::ZERO, half, height, 0.0);
    } else {
        let (top, foot) = (b.draw(Role::Wood), b.draw(Role::Metal));
        b.can(Vec3A::Z * (height - 0.04), half[0].max(half[1]), 0.04, top);
        b.can(Vec3A::ZERO, 0.06, height - 0.04, foot);
    }
    b.palette.detail = b.rng.scale(0.1, 0.3);
    let top = Vec3A::Z * height;
    let size = b.rng.range(0.13, 0.28);
    if b.rng.chance(0.4) {
        let cloth = b.draw(Role::Fabric);
        let turn = b.rng.angle();
        b.block(top, [0.6 * half[1], 0.45 * half[1], 0.004], turn, cloth);
    }
    let count = b.rng.count(3, 14);
    for place in scatter(&mut b.rng, count, 0.8 * half[0].min(half[1]), 0.8 * size) {
        if b.primitives.len() > 54 {
            break;
        }
        let (at, scale) = (top + Vec3A::from(place.extend(0.0)), size * b.rng.range(0.6, 1.4));
        b.thing(at, scale);
    }
    b.primitives.truncate(60);

    let lamp = Vec3A::new(0.8 * b.rng.signed(), 0.8 * b.rng.signed(), high.z - 0.3);
    let (light, sky) = if indoors { lamplight(&mut b.rng, lamp, 1.2) } else { daylight(&mut b.rng) };
    let reach = b.rng.range(0.8, 1.1);
    let bounds = if indoors { [low + 0.15, high - 0.2] } else { [Vec3A::splat(-9.0), Vec3A::splat(9.0)] };
    let center = 0.1 * Vec3A::new(b.rng.signed(), b.rng.signed(), 0.0).xy();
    let stage = Stage {
        target: Vec3A::new(center.x, center.y, height + b.rng.range(0.0, 0.12)),
        distance: [0.75 * reach, 1.2 * reach],
        elevation: [0.2, 0.9],
        front: b.rng.angle(),
        freedom: PI,
        bounds: [bounds[0].with_z(height + 0.05), bounds[1]],
        paths: &PathKind::ALL_AROUND,
    };
    Setting { light, sky, room: indoors.then_some(Room { low, high }), stage }
}
