use std::f32::consts::FRAC_PI_2;

use glam::Vec3A;

use super::{Setting, daylight};
use crate::procedural::builder::Builder;
use crate::procedural::material::{Material, Role};
use crate::procedural::path::{PathKind, Stage};
use crate::procedural::world::Key;

pub(super) fn build(b: &mut Builder) -> Setting {
    let (half_width, height) = (b.rng.range(4.0, 9.0), b.rng.range(4.0, 10.0));
    b.palette.detail = b.rng.scale(0.6, 1.8);
    let (street, wall) = (b.draw(Role::Ground), b.draw(Role::Facade));
    b.rectangle(Vec3A::ZERO, [80.0; 2], Vec3A::Z, street);
    b.block(Vec3A::new(0.0, 4.0, height / 2.0), [half_width, 4.0, height / 2.0], 0.0, wall);
    let trim = b.draw(Role::Stone);
    windows(b, half_width, height, trim);
    let (cornice, pavement) = (b.rng.range(0.1, 0.35), b.rng.range(1.0, 2.0));
    b.block(Vec3A::new(0.0, -0.0, height), [half_width + cornice, cornice, 0.15], 0.0, trim);
    b.block(Vec3A::new(0.0, -pavement, 0.06), [half_width + 1.0, pavement, 0.08], 0.0, trim);
    door(b, half_width, trim);
    for side in [-1.0, 1.0] {
        if b.rng.chance(0.7) {
            let (neighbor, set_back) = (b.draw(Role::Facade), 4.0 + b.rng.range(-1.5, 1.5));
            let tall = height * b.rng.range(0.5, 1.2) / 2.0;
            b.block(Vec3A::new(side * (half_width + 4.0), set_back, tall), [4.0, 4.0, tall], 0.0, neighbor);
        }
    }
    while b.primitives.len() < 60 && b.rng.chance(0.85) {
        before(b, half_width);
    }
    b.primitives.truncate(60);

    let (mut light, sky) = daylight(&mut b.rng);
    if let Key::Sun(towards) = &mut light.key {
        // Shaded fronts are dull.
        let sunny = b.rng.chance(0.75);
        towards.y = if sunny { -towards.y.abs() } else { towards.y };
    }
    let reach = b.rng.range(4.0, 10.0);
    let stage = Stage {
        target: Vec3A::new(0.4 * half_width * b.rng.signed(), 0.0, b.rng.range(0.25, 0.5) * height),
        distance: [0.8 * reach, 1.2 * reach],
        elevation: [-0.1, 0.25],
        front: -FRAC_PI_2 + 0.4 * b.rng.signed(),
        freedom: 0.9,
        bounds: [Vec3A::new(-30.0, -25.0, 0.8), Vec3A::new(30.0, -0.8, 12.0)],
        paths: &[PathKind::Arc, PathKind::Walk, PathKind::Sweep, PathKind::Sweep, PathKind::Handheld],
    };
    Setting { light, sky, room: None, stage }
}

fn windows(b: &mut Builder, half_width: f32, height: f32, trim: Material) {
    let (columns, rows) = (b.rng.count(2, 5), ((height / 2.8) as usize).clamp(1, 3));
    let (pane, sill) = (b.draw(Role::Glass), b.rng.chance(0.6));
    let half = [b.rng.range(0.35, 0.7), b.rng.range(0.5, 0.85)];
    for (column, row) in (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row))) {
        let x = half_width * (2.0 * (column as f32 + 0.5) / columns as f32 - 1.0);
        let z = height * (row as f32 + 0.6) / rows as f32;
        b.block(Vec3A::new(x, 0.0, z), [half[0] + 0.1, 0.06, half[1] + 0.1], 0.0, trim);
        b.block(Vec3A::new(x, 0.0, z), [half[0], 0.075, half[1]], 0.0, pane);
        if sill {
            b.block(Vec3A::new(x, -0.05, z - half[1] - 0.1), [half[0] + 0.2, 0.15, 0.05], 0.0, trim);
        }
    }
}

fn door(b: &mut Builder, half_width: f32, trim: Material) {
    let (leaf, knob) = (b.draw(Role::Wood), b.draw(Role::Metal));
    let x = 0.6 * half_width * b.rng.signed();
    b.block(Vec3A::new(x, 0.0, 1.15), [0.65, 0.12, 1.2], 0.0, trim);
    b.block(Vec3A::new(x, 0.0, 1.05), [0.52, 0.15, 1.05], 0.0, leaf);
    b.ball(Vec3A::new(x + 0.4, -0.17, 1.0), [0.05; 3], knob);
    if b.rng.chance(0.5) {
        let side = x + 0.9;
        b.rod(Vec3A::new(side, -0.15, 0.0), Vec3A::new(side, -0.15, 6.0), 0.06, trim);
    }
}

fn before(b: &mut Builder, half_width: f32) {
    let place = Vec3A::new(half_width * b.rng.signed(), -b.rng.range(0.6, 5.0), 0.08);
    match b.rng.count(0, 5) {
        0 if place.y < -1.5 => {
            let height = b.rng.range(2.5, 5.0);
            b.tree(place, height);
        }
        1 => b.plant(place, 1.0),
        2 => {
            let (post, step) = (b.draw(Role::Metal), b.rng.range(0.5, 1.2));
            for i in 0..4 {
                let foot = place + Vec3A::X * (step * i as f32);
                b.rod(foot, foot + Vec3A::Z, 0.05, post);
            }
            b.rod(place + Vec3A::Z * 0.8, place + Vec3A::new(3.0 * step, 0.0, 0.8), 0.04, post);
        }
        3 => car(b, place),
        _ => {
            let size = b.rng.range(0.4, 1.3);
            b.solid(place, size);
        }
    }
}

fn car(b: &mut Builder, place: Vec3A) {
    let (body, glass, tyre) = (b.draw(Role::Anything), b.draw(Role::Glass), b.draw(Role::Metal));
    let place = place.with_y(place.y.min(-2.5));
    b.block(place + Vec3A::Z * 0.55, [1.8, 0.75, 0.3], 0.0, body);
    b.block(place + Vec3A::new(0.2, 0.0, 1.0), [1.0, 0.65, 0.25], 0.0, glass);
    for (x, y) in [(-1.1, -0.75), (1.1, -0.75), (-1.1, 0.75), (1.1, 0.75)] {
        let wheel = place + Vec3A::new(x, y, 0.25);
        b.rod(wheel - Vec3A::Y * 0.1, wheel + Vec3A::Y * 0.1, 0.33, tyre);
    }
}
