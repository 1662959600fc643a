mod clutter;
mod facade;
mod room;
mod table;
mod terrain;

use std::f32::consts::PI;
use std::fmt;

use glam::{Vec2, Vec3A};

use super::builder::Builder;
use super::material::{Palette, Role};
use super::path::Stage;
use super::photos::Photos;
use super::rng::Rng;
use super::world::{Key, Light, Room, Sky, World};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    Room,
    Table,
    Facade,
    Terrain,
    /// Heap of primitives, outdoors or between walls.
    Clutter,
}

impl fmt::Display for Family {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Room => "room",
            Self::Table => "table",
            Self::Facade => "facade",
            Self::Terrain => "terrain",
            Self::Clutter => "heap",
        })
    }
}

impl Family {
    pub const ALL: [Self; 5] = [Self::Room, Self::Table, Self::Facade, Self::Terrain, Self::Clutter];

    pub(super) fn build(self, rng: Rng, photos: &Photos) -> (World, Stage) {
        let mut b = Builder { rng, palette: Palette { photos, detail: 1.0, photo_share: 0.4 }, primitives: Vec::new() };
        let Setting { light, sky, room, stage } = match self {
            Self::Room => room::build(&mut b),
            Self::Table => table::build(&mut b),
            Self::Facade => facade::build(&mut b),
            Self::Terrain => terrain::build(&mut b),
            Self::Clutter => clutter::build(&mut b),
        };
        (World::new(b.primitives, light, sky, room), stage)
    }
}

struct Setting {
    light: Light,
    sky: Sky,
    room: Option<Room>,
    stage: Stage,
}

fn daylight(rng: &mut Rng) -> (Light, Sky) {
    let (azimuth, elevation) = (rng.angle(), rng.range(0.35, 1.25));
    let sun = Vec3A::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
    let low = 1.0 - elevation / 1.25;
    let strength = rng.range(0.5, 2.0);
    let color = strength * Vec3A::new(1.0, 0.95 - 0.12 * low, 0.85 - 0.3 * low);
    let blue = rng.range(0.0, 1.0);
    let zenith = rng.range(0.6, 1.0) * Vec3A::new(0.85 - 0.62 * blue, 0.9 - 0.43 * blue, 1.0);
    let horizon = rng.range(0.8, 1.1) * Vec3A::new(0.95 - 0.2 * blue, 0.97 - 0.1 * blue, 1.0);
    let ambient = [rng.range(0.35, 0.7) * zenith, rng.range(0.12, 0.3) * Vec3A::new(1.0, 0.95, 0.85)];
    let sky = Sky {
        zenith,
        horizon,
        clouds: rng.unit(),
        offset: 10.0 * Vec3A::splat(rng.unit()),
        haze: rng.scale(150.0, 3000.0),
    };
    (Light { key: Key::Sun(sun), color, ambient }, sky)
}

/// Light from a lamp and walls; no visible sky.
fn lamplight(rng: &mut Rng, lamp: Vec3A, reference: f32) -> (Light, Sky) {
    let warmth = rng.range(0.0, 0.3);
    let color = rng.range(0.5, 1.2) * Vec3A::new(1.0, 1.0 - 0.5 * warmth, 1.0 - warmth);
    let ambient = [rng.range(0.35, 0.6), rng.range(0.25, 0.45)].map(|level| level * Vec3A::new(1.0, 0.98, 0.95));
    let gray = Vec3A::splat(0.5);
    let sky = Sky { zenith: gray, horizon: gray, clouds: 0.0, offset: Vec3A::ZERO, haze: 1e5 };
    (Light { key: Key::Lamp(lamp, reference), color, ambient }, sky)
}

/// Up to `count` places in a disc, at least `gap` apart.
fn scatter(rng: &mut Rng, count: usize, radius: f32, gap: f32) -> Vec<Vec2> {
    let mut places: Vec<Vec2> = Vec::new();
    for _ in 0..8 * count {
        let place = radius * rng.unit().sqrt() * Vec2::from_angle(PI * rng.signed());
        if places.len() < count && places.iter().all(|other| other.distance(place) > gap) {
            places.push(place);
        }
    }
    places
}

/// Adds pictures or shelves: `origin` is the middle of the wall's foot, `normal` points inward.
fn hang(b: &mut Builder, origin: Vec3A, normal: Vec3A, half_width: f32, height: f32) {
    let along = Vec3A::Z.cross(normal);
    let axes = super::builder::facing(normal);
    for _ in 0..b.rng.count(1, 3) {
        let half = Vec3A::new(b.rng.range(0.2, 0.6), b.rng.range(0.2, 0.5), 0.02);
        let clearance = (half_width - half.x).max(0.0);
        let center =
            origin + along * (clearance * b.rng.signed()) + Vec3A::Z * (height * b.rng.range(0.5, 0.7)) + normal * 0.02;
        let picture = b.draw(Role::Picture);
        let (frame, depth) = (b.draw(Role::Wood), b.rng.range(0.02, 0.05));
        b.put(super::shape::Shape::Box { half: half + Vec3A::new(0.04, 0.04, 0.0) }, center, axes, frame);
        b.put(super::shape::Shape::Box { half: half.with_z(depth) }, center, axes, picture);
    }
}
