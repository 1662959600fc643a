use glam::{Vec3, Vec3A};

use super::photos::Photos;
use super::rng::Rng;
use super::texture::{Pattern, Texture};

#[derive(Clone, Copy, Debug)]
pub(super) struct Material {
    pub texture: Texture,
    pub specular: f32,
    pub shininess: f32,
    /// Factor of albedo.
    pub glow: f32,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Role {
    /// Earth, grass, gravel, paving.
    Ground,
    Floor,
    Wall,
    /// Masonry and plaster outdoors.
    Facade,
    Wood,
    Foliage,
    Fabric,
    Stone,
    Metal,
    Glass,
    Picture,
    Anything,
}

/// `detail`: typical feature size in meters.
pub(super) struct Palette<'a> {
    pub photos: &'a Photos,
    pub detail: f32,
    /// If photos exist.
    pub photo_share: f32,
}

impl Palette<'_> {
    pub fn draw(&self, rng: &mut Rng, role: Role) -> Material {
        let (specular, shininess) = self.finish(rng, role);
        Material { texture: self.texture(rng, role), specular, shininess, glow: 0.0 }
    }

    fn finish(&self, rng: &mut Rng, role: Role) -> (f32, f32) {
        match role {
            Role::Metal | Role::Glass => (rng.range(0.3, 0.9), rng.scale(20.0, 120.0)),
            Role::Ground | Role::Foliage | Role::Fabric | Role::Facade | Role::Stone => (0.0, 8.0),
            Role::Wood | Role::Floor => (rng.range(0.0, 0.25), rng.scale(10.0, 50.0)),
            Role::Wall | Role::Picture => (rng.range(0.0, 0.05), 10.0),
            Role::Anything if rng.chance(0.5) => (rng.range(0.05, 0.6), rng.scale(10.0, 90.0)),
            Role::Anything => (0.0, 8.0),
        }
    }

    fn texture(&self, rng: &mut Rng, role: Role) -> Texture {
        if let Some(texture) = self.photo(rng, role) {
            return texture;
        }
        let colors = colors(rng, role);
        let (pattern, period) = pattern(rng, role);
        let period = period * self.detail * rng.scale(0.6, 1.6);
        let stain = (rng.range(0.1, 0.6), period * rng.scale(0.15, 3.0));
        Texture { pattern, period, offset: offset(rng), colors, stain }
    }

    fn photo(&self, rng: &mut Rng, role: Role) -> Option<Texture> {
        let share = match role {
            Role::Picture => 1.0,
            Role::Glass | Role::Wood | Role::Metal => 0.0,
            Role::Wall | Role::Floor => 0.5 * self.photo_share,
            _ => self.photo_share,
        };
        let crops = self.photos.crops.len();
        if crops == 0 || !rng.chance(share) {
            return None;
        }
        let wide = matches!(role, Role::Ground | Role::Floor | Role::Wall | Role::Facade);
        let period = self.detail * if wide { rng.scale(1.5, 6.0) } else { rng.scale(0.8, 4.0) };
        let stain = (rng.range(0.05, 0.4), period * rng.scale(0.03, 0.5));
        let tint = Vec3A::ONE + 0.15 * Vec3A::new(rng.signed(), rng.signed(), rng.signed());
        let pattern = Pattern::Photo(rng.count(0, crops - 1));
        Some(Texture { pattern, period, offset: offset(rng), colors: [tint; 3], stain })
    }

    pub fn terrain(&self, rng: &mut Rng) -> Material {
        let crops = self.photos.crops.len();
        let photo = (crops > 0 && rng.chance(self.photo_share)).then(|| rng.count(0, crops.max(1) - 1));
        let colors = [colors(rng, Role::Ground)[0], colors(rng, Role::Foliage)[1], colors(rng, Role::Stone)[1]];
        let texture = Texture {
            pattern: Pattern::Slope { photo },
            period: self.detail * rng.scale(2.0, 6.0),
            offset: offset(rng),
            colors,
            stain: (rng.range(0.2, 0.7), self.detail * rng.scale(2.0, 8.0)),
        };
        Material { texture, specular: 0.0, shininess: 8.0, glow: 0.0 }
    }
}

/// Pattern and its period in units of [`Palette::detail`].
type Drawn = (Pattern, f32);

type Draw = fn(&mut Rng) -> Drawn;

const CLOUDS: Draw = |_| noise(5, [1.0; 3], 1.2);
const GRAVEL: Draw = |_| noise(5, [1.0; 3], 0.35);
const SPECKLE: Draw = |_| noise(5, [1.0; 3], 0.2);
const LEAVES: Draw = |_| noise(5, [1.0; 3], 0.18);
const PLASTER: Draw = |_| noise(5, [1.0, 1.0, 0.6], 0.7);
const STRATA: Draw = |_| noise(5, [1.0, 1.0, 2.5], 0.8);
const MARBLE: Draw = |_| (Pattern::Marble, 0.8);
const RINGS: Draw = |_| (Pattern::Rings, 0.3);
const GRADIENT: Draw = |_| (Pattern::Gradient, 1.0);
const COBBLES: Draw = |_| (Pattern::Voronoi { border: 0.06 }, 0.35);
const CHECKER: Draw = |rng| (Pattern::Checker, rng.scale(0.2, 0.8));
const STRIPES: Draw = |rng| (Pattern::Stripes(rng.range(0.2, 0.8)), 0.35);
const SPOTS: Draw = |rng| (Pattern::Spots(rng.range(0.15, 0.4)), 0.35);
const PLANKS: Draw = |rng| (Pattern::Planks(rng.range(5.0, 14.0)), 0.25);
const BRICKS: Draw =
    |rng| (Pattern::Bricks { aspect: rng.range(1.8, 3.5), mortar: rng.range(0.06, 0.16), shift: 0.5 }, 0.25);
const TILES: Draw = |rng| (Pattern::Bricks { aspect: rng.pick(&[1.0, 1.0, 2.0]), mortar: 0.05, shift: 0.0 }, 0.7);

fn pattern(rng: &mut Rng, role: Role) -> Drawn {
    let choices: &[Draw] = match role {
        Role::Ground => &[COBBLES, TILES, BRICKS, CLOUDS, GRAVEL, GRAVEL],
        Role::Floor => &[CHECKER, TILES, SPECKLE, PLANKS, PLANKS],
        Role::Wall => &[BRICKS, STRIPES, SPOTS, SPECKLE, CLOUDS, GRAVEL],
        Role::Facade => &[TILES, PLASTER, BRICKS, BRICKS],
        Role::Wood => &[PLANKS, RINGS],
        Role::Foliage => &[LEAVES],
        Role::Fabric => &[STRIPES, SPOTS, CHECKER, SPECKLE, SPECKLE],
        Role::Stone => &[STRATA, MARBLE],
        Role::Metal => &[|_| noise(3, [1.0, 1.0, 6.0], 0.6)],
        Role::Glass => &[|_| noise(2, [1.0; 3], 2.0)],
        Role::Picture | Role::Anything => {
            &[CHECKER, STRIPES, BRICKS, MARBLE, RINGS, SPOTS, GRADIENT, COBBLES, SPECKLE, CLOUDS, CLOUDS]
        }
    };
    rng.pick(choices)(rng)
}

fn noise(octaves: usize, stretch: [f32; 3], period: f32) -> Drawn {
    (Pattern::Noise { octaves, stretch: Vec3::from(stretch) }, period)
}

fn offset(rng: &mut Rng) -> Vec3A {
    20.0 * Vec3A::new(rng.unit(), rng.unit(), rng.unit())
}

fn colors(rng: &mut Rng, role: Role) -> [Vec3A; 3] {
    let (hues, saturation, value) = match role {
        Role::Ground => ([0.06, 0.32], [0.1, 0.5], [0.25, 0.7]),
        Role::Floor | Role::Wood => ([0.04, 0.11], [0.25, 0.7], [0.3, 0.8]),
        Role::Wall => ([0.0, 1.0], [0.0, 0.3], [0.55, 0.95]),
        Role::Facade => ([0.0, 0.14], [0.1, 0.6], [0.4, 0.9]),
        Role::Foliage => ([0.16, 0.36], [0.3, 0.75], [0.25, 0.8]),
        Role::Stone => ([0.0, 1.0], [0.0, 0.2], [0.35, 0.85]),
        Role::Metal => ([0.0, 1.0], [0.0, 0.3], [0.3, 0.7]),
        Role::Glass => ([0.5, 0.65], [0.1, 0.4], [0.1, 0.35]),
        Role::Fabric | Role::Picture | Role::Anything => ([0.0, 1.0], [0.1, 0.85], [0.25, 0.95]),
    };
    let hue = rng.range(hues[0], hues[1]);
    let contrasting = role == Role::Anything || role == Role::Fabric || role == Role::Picture;
    let mut color = |shift: f32, low: f32, high: f32| {
        let saturation = rng.range(saturation[0], saturation[1]);
        let brightness = value[0] + (value[1] - value[0]) * rng.range(low, high);
        from_hsv(hue + shift * rng.signed(), saturation, brightness)
    };
    let shift = if contrasting { 0.3 } else { 0.04 };
    let mut three = [color(0.02, 0.0, 0.4), color(shift, 0.4, 0.8), color(shift, 0.7, 1.0)];
    if contrasting && rng.chance(0.5) {
        three.swap(0, 2);
    }
    three
}

/// sRGB in 0..1 to linear RGB.
fn from_hsv(hue: f32, saturation: f32, value: f32) -> Vec3A {
    let channel = |shift: f32| {
        let k = (6.0 * hue.rem_euclid(1.0) + shift) % 6.0;
        value * (1.0 - saturation * k.min(4.0 - k).clamp(0.0, 1.0))
    };
    super::tone::srgb_to_linear(Vec3A::new(channel(5.0), channel(3.0), channel(1.0)))
}
