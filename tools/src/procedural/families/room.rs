use std::f32::consts::{FRAC_PI_2, PI};

use glam::Vec3A;

use super::{Setting, hang, lamplight};
use crate::procedural::builder::Builder;
use crate::procedural::material::Role;
use crate::procedural::path::{PathKind, Stage};
use crate::procedural::world::Room;

pub(super) fn build(b: &mut Builder) -> Setting {
    let half = Vec3A::new(b.rng.range(1.8, 3.6), b.rng.range(1.8, 3.6), b.rng.range(1.2, 1.6));
    let (low, high) = (Vec3A::new(-half.x, -half.y, 0.0), Vec3A::new(half.x, half.y, 2.0 * half.z));
    b.palette.detail = b.rng.scale(0.4, 1.2);
    b.shell(low, high);
    if b.rng.chance(0.6) {
        let rug = b.draw(Role::Fabric);
        let (sides, turn) =
            ([b.rng.range(0.3, 0.6) * half.x, b.rng.range(0.3, 0.6) * half.y, 0.01], 0.3 * b.rng.signed());
        b.block(Vec3A::Z * 0.005, sides, turn, rug);
    }
    if b.rng.chance(0.7) {
        dining(b);
    }
    for normal in [Vec3A::X, Vec3A::Y, Vec3A::NEG_X, Vec3A::NEG_Y] {
        let foot = -normal * half.with_z(0.0);
        let wide = if normal.x == 0.0 { half.x } else { half.y };
        match b.rng.count(0, 4) {
            0 => sofa(b, foot, normal, wide),
            1 => shelf(b, foot, normal, wide),
            2 => cabinet(b, foot, normal, wide),
            3 => window(b, foot, normal, wide, 2.0 * half.z),
            _ => {}
        }
        if b.rng.chance(0.6) && b.primitives.len() < 54 {
            hang(b, foot, normal, wide - 0.1, 2.0 * half.z);
        }
    }
    while b.primitives.len() < 16 || (b.primitives.len() < 56 && b.rng.chance(0.8)) {
        let (place, size) =
            (Vec3A::new(b.rng.signed() * (half.x - 0.4), b.rng.signed() * (half.y - 0.4), 0.0), b.rng.range(0.25, 0.8));
        if b.rng.chance(0.15) { b.plant(place, 1.2) } else { b.solid(place, size) }
    }
    b.primitives.truncate(60);

    let lamp = Vec3A::new(0.5 * half.x * b.rng.signed(), 0.5 * half.y * b.rng.signed(), 1.85 * half.z);
    let (light, sky) = lamplight(&mut b.rng, lamp, half.z);
    let reach = half.x.min(half.y);
    let stage = Stage {
        target: Vec3A::new(0.3 * half.x * b.rng.signed(), 0.3 * half.y * b.rng.signed(), b.rng.range(0.5, 1.1)),
        distance: [0.7 * reach, 1.3 * reach],
        elevation: [0.05, 0.45],
        front: b.rng.angle(),
        freedom: PI,
        bounds: [low + 0.3, high - 0.4],
        paths: &PathKind::ALL_AROUND,
    };
    Setting { light, sky, room: Some(Room { low, high }), stage }
}

fn dining(b: &mut Builder) {
    let place = Vec3A::new(0.4 * b.rng.signed(), 0.4 * b.rng.signed(), 0.0);
    let (half, height, heading) =
        ([b.rng.range(0.4, 0.8), b.rng.range(0.35, 0.5)], b.rng.range(0.4, 0.78), b.rng.angle());
    b.table(place, half, height, heading);
    for _ in 0..b.rng.count(1, 3) {
        let at = Vec3A::new(0.5 * half[0] * b.rng.signed(), 0.5 * half[1] * b.rng.signed(), height);
        let size = b.rng.range(0.15, 0.3);
        b.thing(place + at, size);
    }
    if b.rng.chance(0.5) {
        let turn = heading + 0.3 * b.rng.signed();
        let behind = glam::Mat3A::from_rotation_z(heading) * Vec3A::new(0.0, half[1] + 0.3, 0.0);
        b.chair(place + behind, turn);
    }
}

/// y points into the room.
fn heading(normal: Vec3A) -> f32 {
    normal.y.atan2(normal.x) - FRAC_PI_2
}

fn beside(b: &mut Builder, foot: Vec3A, normal: Vec3A, clearance: f32, depth: f32) -> Vec3A {
    foot + normal * depth + Vec3A::Z.cross(normal) * (clearance.max(0.0) * b.rng.signed())
}

fn sofa(b: &mut Builder, foot: Vec3A, normal: Vec3A, wide: f32) {
    let (fabric, cushion) = (b.draw(Role::Fabric), b.draw(Role::Fabric));
    let half = b.rng.range(0.5, 1.0);
    let place = beside(b, foot, normal, wide - half - 0.2, 0.45);
    let (turn, along) = (heading(normal), Vec3A::Z.cross(normal));
    b.block(place + Vec3A::Z * 0.2, [half, 0.42, 0.2], turn, fabric);
    b.block(place - normal * 0.32 + Vec3A::Z * 0.55, [half, 0.1, 0.25], turn, fabric);
    for side in [-1.0, 1.0] {
        b.block(place + along * (side * half) + Vec3A::Z * 0.3, [0.1, 0.42, 0.3], turn, fabric);
        b.ball(place + along * (side * 0.6 * half) - normal * 0.12 + Vec3A::Z * 0.55, [0.2, 0.2, 0.15], cushion);
    }
}

fn shelf(b: &mut Builder, foot: Vec3A, normal: Vec3A, wide: f32) {
    let wood = b.draw(Role::Wood);
    let half = b.rng.range(0.4, 0.7);
    let place = beside(b, foot, normal, wide - half - 0.1, 0.18);
    let (turn, along) = (heading(normal), Vec3A::Z.cross(normal));
    for level in 0..b.rng.count(2, 3) {
        let board = place + Vec3A::Z * (0.5 + 0.45 * level as f32);
        b.block(board, [half, 0.16, 0.015], turn, wood);
        for _ in 0..b.rng.count(1, 4) {
            let sides = [b.rng.range(0.02, 0.12), b.rng.range(0.06, 0.12), b.rng.range(0.08, 0.18)];
            let (at, cover) =
                (along * (0.85 * half * b.rng.signed()) + Vec3A::Z * (sides[2] + 0.015), b.draw(Role::Picture));
            b.block(board + at, sides, turn, cover);
        }
    }
}

fn cabinet(b: &mut Builder, foot: Vec3A, normal: Vec3A, wide: f32) {
    let (wood, knob) = (b.draw(Role::Wood), b.draw(Role::Metal));
    let half = [b.rng.range(0.35, 0.7), b.rng.range(0.18, 0.28), b.rng.range(0.35, 0.9)];
    let place = beside(b, foot, normal, wide - half[0] - 0.1, half[1]);
    let (turn, along) = (heading(normal), Vec3A::Z.cross(normal));
    b.block(place + Vec3A::Z * half[2], half, turn, wood);
    for side in [-0.1, 0.1] {
        b.ball(place + normal * half[1] + along * side + Vec3A::Z * half[2], [0.03; 3], knob);
    }
    let (at, size) = (place + Vec3A::Z * (2.0 * half[2]), b.rng.range(0.2, 0.4));
    b.thing(at, size);
}

fn window(b: &mut Builder, foot: Vec3A, normal: Vec3A, wide: f32, height: f32) {
    let (mut view, frame) = (b.draw(Role::Picture), b.draw(Role::Wall));
    view.glow = b.rng.range(0.8, 1.6);
    let half = [b.rng.range(0.35, 0.7), b.rng.range(0.4, 0.55)];
    let center = beside(b, foot, normal, wide - half[0] - 0.1, 0.02) + Vec3A::Z * (0.6 * height);
    let (turn, along) = (heading(normal), Vec3A::Z.cross(normal));
    b.rectangle(center, half, normal, view);
    for side in [-1.0, 0.0, 1.0] {
        b.block(center + along * (side * half[0]), [0.035, 0.035, half[1] + 0.03], turn, frame);
    }
    for side in [-1.0, 1.0] {
        b.block(center + Vec3A::Z * (side * half[1]), [half[0] + 0.03, 0.04, 0.035], turn, frame);
    }
}
