//! Surface patterns, averaged over the pixel's footprint in closed form or by fading.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3, Vec3A, Vec3Swizzles};

use super::noise::{fade, fbm, hash, hash_unit, smoothstep, voronoi};
use super::photos::Photos;

/// Lengths in meters, in the primitive's frame.
pub(super) struct Place {
    pub position: Vec3A,
    pub normal: Vec3A,
    /// On the unrolled surface.
    pub uv: Vec2,
    /// Of one pixel.
    pub footprint: f32,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pattern {
    Checker,
    /// Share of the first color.
    Stripes(f32),
    /// Brick aspect ratio, mortar share of the height, shift between rows.
    Bricks {
        aspect: f32,
        mortar: f32,
        shift: f32,
    },
    /// Cubes of noise stretched along the axes.
    Noise {
        octaves: usize,
        stretch: Vec3,
    },
    Marble,
    Rings,
    /// Discs of this radius.
    Spots(f32),
    Gradient,
    Voronoi {
        border: f32,
    },
    /// Boards of this aspect ratio with grain.
    Planks(f32),
    /// Index of a photo, projected along the nearest axes.
    Photo(usize),
    /// Different cover on level and steep ground.
    Slope {
        photo: Option<usize>,
    },
}

/// Linear RGB.
#[derive(Clone, Copy, Debug)]
pub(super) struct Texture {
    pub pattern: Pattern,
    /// Meters.
    pub period: f32,
    /// Meters, against repeated patterns.
    pub offset: Vec3A,
    pub colors: [Vec3A; 3],
    /// Strength, and meters per period.
    pub stain: (f32, f32),
}

impl Texture {
    pub fn color(&self, place: &Place, photos: &Photos) -> Vec3A {
        let p = (place.position + self.offset) / self.period;
        let uv = (place.uv + self.offset.xy()) / self.period;
        let width = place.footprint / self.period;
        let [first, second, third] = self.colors;
        let color = match self.pattern {
            Pattern::Checker => first.lerp(second, checker(uv, width)),
            Pattern::Stripes(share) => second.lerp(first, pulse(uv.x, share, width)),
            Pattern::Bricks { aspect, mortar, shift } => self.bricks(uv, width, aspect, mortar, shift),
            Pattern::Noise { octaves, stretch } => {
                self.ramp(contrast(fbm(p * Vec3A::from(stretch), octaves, width * stretch.max_element())))
            }
            Pattern::Marble => {
                let bend = 5.0 * fbm(p * 0.7, 4, 0.7 * width);
                self.ramp(0.5 + 0.5 * fade(2.0 * width) * (TAU * (p.x + bend)).sin())
            }
            Pattern::Rings => {
                let wobble = fbm(p * Vec3A::new(0.6, 0.6, 0.15), 3, width);
                let ring = (10.0 * (p.xy() * 0.3).length() + 4.0 * wobble).fract();
                let seen = fade(3.0 * width);
                first.lerp(second, 0.5 + seen * (smoothstep(0.0, 0.8, ring) - smoothstep(0.85, 1.0, ring) - 0.5))
            }
            Pattern::Spots(radius) => first.lerp(second, spots(uv, radius, width)),
            Pattern::Gradient => self.ramp(0.5 + 0.5 * (place.position.z / self.period).clamp(-1.0, 1.0)),
            Pattern::Voronoi { border } => {
                let (edge, cell) = voronoi(uv);
                let shade = 0.5 + fade(width) * ((cell >> 24) as f32 / 255.0 - 0.5);
                let joint = fade(2.0 * width) * (1.0 - smoothstep(border, border + 0.05 + width, edge));
                first.lerp(second, shade).lerp(third, joint)
            }
            Pattern::Planks(aspect) => {
                let board = uv.y.floor() as i32;
                let grain = fbm(Vec3A::new(uv.x * 0.6, uv.y * 9.0, board as f32 * 3.7), 3, 9.0 * width);
                self.bricks(uv, width, aspect, 0.02, 0.37) * (0.6 + 0.8 * grain)
            }
            Pattern::Photo(photo) => photos.sample_projected(photo, p, place.normal, width) * first,
            Pattern::Slope { photo } => {
                let level = match photo {
                    Some(photo) => photos.sample(photo, uv, width),
                    None => self.ramp(contrast(fbm(p * 6.0, 5, 6.0 * width))),
                };
                let rock = third * (0.4 + 1.2 * fbm(p * Vec3A::new(4.0, 4.0, 14.0), 5, 8.0 * width));
                let bare = smoothstep(0.80, 0.92, place.normal.z + 0.25 * (fbm(p * 2.0, 3, 2.0 * width) - 0.5));
                rock.lerp(level, bare)
            }
        };
        let (amount, size) = self.stain;
        let stain = fbm((place.position + self.offset) / size, 3, place.footprint / size);
        color * (1.0 + 2.0 * amount * (stain - 0.5)).max(0.1)
    }

    fn ramp(&self, t: f32) -> Vec3A {
        let t = 2.0 * t.clamp(0.0, 1.0);
        let [first, second, third] = self.colors;
        if t < 1.0 { first.lerp(second, t) } else { second.lerp(third, t - 1.0) }
    }

    fn bricks(&self, uv: Vec2, width: f32, aspect: f32, mortar: f32, shift: f32) -> Vec3A {
        let row = uv.y.floor();
        let along = uv.x / aspect + shift * row;
        let (i, j) = (along.floor() as i32, row as i32);
        let covered = pulse(along, 1.0 - mortar / aspect, width / aspect) * pulse(uv.y, 1.0 - mortar, width);
        let shade = 0.5 + fade(width) * (hash_unit(i, j, 3) - 0.5);
        let [first, second, third] = self.colors;
        third.lerp(first.lerp(second, shade), covered)
    }
}

/// Spreads fractal noise over 0..1.
fn contrast(noise: f32) -> f32 {
    0.5 + 1.7 * (noise - 0.5)
}

/// Pulse wave of duty cycle `share` and period 1, averaged over `width`.
fn pulse(x: f32, share: f32, width: f32) -> f32 {
    let integral = |x: f32| x.floor() * share + (x - x.floor()).min(share);
    let width = width.max(1e-3);
    ((integral(x + width / 2.0) - integral(x - width / 2.0)) / width).clamp(0.0, 1.0)
}

fn checker(uv: Vec2, width: f32) -> f32 {
    let (a, b) = (pulse(uv.x / 2.0, 0.5, width / 2.0), pulse(uv.y / 2.0, 0.5, width / 2.0));
    a * b + (1.0 - a) * (1.0 - b)
}

fn spots(uv: Vec2, radius: f32, width: f32) -> f32 {
    let cell = uv.floor();
    let word = hash(cell.x as i32, cell.y as i32, 11);
    let jitter = Vec2::new((word & 0xffff) as f32, (word >> 16) as f32) / 65536.0;
    let center = cell + radius + (1.0 - 2.0 * radius) * jitter;
    let edge = width.max(0.02);
    let disc = 1.0 - smoothstep(radius - edge, radius + edge, uv.distance(center));
    let mean = TAU / 2.0 * radius * radius;
    mean + fade(width) * (disc - mean)
}
