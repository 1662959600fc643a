use std::f32::consts::FRAC_PI_2;

use glam::{Mat3A, Vec2, Vec3A};

use super::material::{Material, Palette, Role};
use super::rng::Rng;
use super::shape::{Primitive, Shape};

pub(super) struct Builder<'a> {
    pub rng: Rng,
    pub palette: Palette<'a>,
    pub primitives: Vec<Primitive>,
}

impl Builder<'_> {
    pub fn draw(&mut self, role: Role) -> Material {
        self.palette.draw(&mut self.rng, role)
    }

    pub fn put(&mut self, shape: Shape, center: Vec3A, rotation: Mat3A, material: Material) {
        self.primitives.push(Primitive { shape, rotation, center, to_local: rotation.transpose(), material });
    }

    pub fn block(&mut self, center: Vec3A, half: [f32; 3], heading: f32, material: Material) {
        self.put(Shape::Box { half: Vec3A::from(half) }, center, Mat3A::from_rotation_z(heading), material);
    }

    pub fn ball(&mut self, center: Vec3A, radii: [f32; 3], material: Material) {
        let heading = self.rng.angle();
        self.put(Shape::Ellipsoid { radii: Vec3A::from(radii) }, center, Mat3A::from_rotation_z(heading), material);
    }

    pub fn can(&mut self, base: Vec3A, radius: f32, height: f32, material: Material) {
        let shape = Shape::Cylinder { radius, half_height: height / 2.0 };
        let rotation = Mat3A::from_rotation_z(self.rng.angle());
        self.put(shape, base + Vec3A::Z * (height / 2.0), rotation, material);
    }

    pub fn rod(&mut self, from: Vec3A, to: Vec3A, radius: f32, material: Material) {
        let along = (to - from).normalize_or(Vec3A::Z);
        let x = along.any_orthonormal_vector();
        let rotation = Mat3A::from_cols(x, along.cross(x), along);
        self.put(
            Shape::Cylinder { radius, half_height: (to - from).length() / 2.0 },
            (from + to) / 2.0,
            rotation,
            material,
        );
    }

    /// The y axis is up if possible.
    pub fn rectangle(&mut self, center: Vec3A, half: [f32; 2], normal: Vec3A, material: Material) {
        self.put(Shape::Rectangle { half: Vec2::from(half) }, center, facing(normal), material);
    }

    pub fn shell(&mut self, low: Vec3A, high: Vec3A) {
        let (center, half) = ((low + high) / 2.0, (high - low) / 2.0);
        let (floor, ceiling) = (self.draw(Role::Floor), self.draw(Role::Wall));
        self.rectangle(center.with_z(low.z), [half.x, half.y], Vec3A::Z, floor);
        self.rectangle(center.with_z(high.z), [half.x, half.y], Vec3A::NEG_Z, ceiling);
        let (wall, feature) = (self.draw(Role::Wall), self.draw(Role::Wall));
        for (i, normal) in [Vec3A::X, Vec3A::Y, Vec3A::NEG_X, Vec3A::NEG_Y].into_iter().enumerate() {
            let wide = if normal.x == 0.0 { half.x } else { half.y };
            let material = if i == 1 { feature } else { wall };
            self.rectangle(center - normal * half, [wide, half.z], normal, material);
        }
    }

    pub fn solid(&mut self, base: Vec3A, size: f32) {
        let material = self.draw(Role::Anything);
        let heading = self.rng.angle();
        let mut side = || size * self.rng.range(0.25, 0.6);
        let half = [side(), side(), side()];
        let rotation = Mat3A::from_rotation_z(heading);
        match self.rng.count(0, 6) {
            0 | 1 => self.block(base + Vec3A::Z * half[2], half, heading, material),
            2 | 3 => self.ball(base + Vec3A::Z * half[2], half, material),
            4 => self.can(base, half[0], 2.0 * half[2], material),
            5 => {
                let minor = size * self.rng.range(0.08, 0.18);
                let major = minor + size * self.rng.range(0.1, 0.35);
                let standing = self.rng.chance(0.4);
                let (height, tilt) = if standing { (major + minor, FRAC_PI_2) } else { (minor, 0.0) };
                let rotation = rotation * Mat3A::from_rotation_x(tilt);
                self.put(Shape::Torus { major, minor }, base + Vec3A::Z * height, rotation, material);
            }
            _ => {
                let rotation =
                    rotation * Mat3A::from_rotation_x(self.rng.signed()) * Mat3A::from_rotation_y(self.rng.signed());
                self.put(Shape::Box { half: Vec3A::from(half) }, base + Vec3A::Z * half[2], rotation, material);
            }
        }
    }

    pub fn thing(&mut self, base: Vec3A, size: f32) {
        match self.rng.count(0, 8) {
            0 => self.cup(base, size),
            1 => self.bottle(base, size),
            2 => self.books(base, size),
            3 => self.bowl(base, size),
            4 => self.plant(base, size),
            _ => self.solid(base, size),
        }
    }

    fn cup(&mut self, base: Vec3A, size: f32) {
        let material = self.draw(Role::Anything);
        let (radius, height) = (0.3 * size, 0.75 * size);
        self.can(base, radius, height, material);
        let heading = self.rng.angle();
        let side = Vec3A::new(heading.cos(), heading.sin(), 0.0);
        let rotation = Mat3A::from_rotation_z(heading) * Mat3A::from_rotation_x(FRAC_PI_2);
        let handle = Shape::Torus { major: 0.22 * size, minor: 0.045 * size };
        self.put(handle, base + side * radius + Vec3A::Z * (height / 2.0), rotation, material);
    }

    fn bottle(&mut self, base: Vec3A, size: f32) {
        let (glass, label) = (self.draw(Role::Anything), self.draw(Role::Picture));
        let (radius, height) = (0.22 * size, self.rng.range(0.8, 1.2) * size);
        self.can(base, radius, height, glass);
        self.can(base + Vec3A::Z * (0.2 * height), 1.02 * radius, 0.5 * height, label);
        self.ball(base + Vec3A::Z * height, [radius, radius, 0.8 * radius], glass);
        self.can(base + Vec3A::Z * height, 0.35 * radius, 0.45 * height, glass);
    }

    fn books(&mut self, base: Vec3A, size: f32) {
        let mut height = 0.0;
        let heading = self.rng.angle();
        for _ in 0..self.rng.count(2, 4) {
            let half =
                [size * self.rng.range(0.35, 0.6), size * self.rng.range(0.28, 0.42), size * self.rng.range(0.03, 0.1)];
            let (turn, material) = (heading + 0.3 * self.rng.signed(), self.draw(Role::Picture));
            self.block(base + Vec3A::Z * (height + half[2]), half, turn, material);
            height += 2.0 * half[2];
        }
    }

    fn bowl(&mut self, base: Vec3A, size: f32) {
        let (dish, fruit) = (self.draw(Role::Anything), self.draw(Role::Anything));
        self.can(base, 0.5 * size, 0.06 * size, dish);
        self.put(
            Shape::Torus { major: 0.5 * size, minor: 0.07 * size },
            base + Vec3A::Z * (0.08 * size),
            Mat3A::IDENTITY,
            dish,
        );
        for i in 0..self.rng.count(2, 4) {
            let (angle, radius) = (2.1 * i as f32 + self.rng.unit(), size * self.rng.range(0.14, 0.22));
            let place = Vec3A::new(angle.cos(), angle.sin(), 0.0) * (0.24 * size) + Vec3A::Z * (radius + 0.06 * size);
            let width = radius * self.rng.range(0.8, 1.0);
            self.ball(base + place, [radius, width, radius], fruit);
        }
    }

    pub fn plant(&mut self, base: Vec3A, size: f32) {
        let (pot, leaves) = (self.draw(Role::Anything), self.draw(Role::Foliage));
        self.can(base, 0.28 * size, 0.4 * size, pot);
        for _ in 0..self.rng.count(3, 5) {
            let to = Vec3A::new(0.35 * self.rng.signed(), 0.35 * self.rng.signed(), self.rng.range(0.6, 1.1)) * size;
            self.rod(base + Vec3A::Z * (0.3 * size), base + to, 0.02 * size, leaves);
            let leaf = size * self.rng.range(0.1, 0.22);
            self.ball(base + to, [leaf, 0.8 * leaf, 0.6 * leaf], leaves);
        }
    }

    /// Returns the height of its top.
    pub fn table(&mut self, base: Vec3A, half: [f32; 2], height: f32, heading: f32) {
        let (top, legs) = (self.draw(Role::Wood), self.draw(Role::Wood));
        let board = 0.025 * (1.0 + self.rng.unit());
        self.block(base + Vec3A::Z * (height - board), [half[0], half[1], board], heading, top);
        let turn = Mat3A::from_rotation_z(heading);
        for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let foot = turn * Vec3A::new(x * 0.88 * half[0], y * 0.85 * half[1], 0.0);
            let center = base + foot + Vec3A::Z * (height / 2.0 - board);
            self.block(center, [0.035, 0.035, height / 2.0 - board], heading, legs);
        }
    }

    pub fn chair(&mut self, base: Vec3A, heading: f32) {
        let (seat, frame) = (self.draw(Role::Fabric), self.draw(Role::Wood));
        let turn = Mat3A::from_rotation_z(heading);
        self.block(base + Vec3A::Z * 0.45, [0.22, 0.22, 0.03], heading, seat);
        self.block(base + turn * Vec3A::new(0.0, 0.21, 0.72), [0.22, 0.02, 0.25], heading, seat);
        for (x, y) in [(-0.19, -0.19), (0.19, -0.19), (-0.19, 0.19), (0.19, 0.19)] {
            let foot = base + turn * Vec3A::new(x, y, 0.0);
            self.rod(foot, foot + Vec3A::Z * 0.43, 0.02, frame);
        }
    }

    pub fn tree(&mut self, base: Vec3A, height: f32) {
        let (trunk, leaves) = (self.draw(Role::Wood), self.draw(Role::Foliage));
        self.can(base - Vec3A::Z * 0.3, 0.04 * height, 0.55 * height + 0.3, trunk);
        for _ in 0..self.rng.count(3, 6) {
            let radius = height * self.rng.range(0.14, 0.26);
            let place = Vec3A::new(0.2 * self.rng.signed(), 0.2 * self.rng.signed(), self.rng.range(0.5, 0.9)) * height;
            let tall = radius * self.rng.range(0.7, 1.0);
            self.ball(base + place, [radius, radius, tall], leaves);
        }
    }

    pub fn house(&mut self, base: Vec3A, size: f32, heading: f32) {
        let (walls, roof) = (self.draw(Role::Facade), self.draw(Role::Facade));
        let half = [0.5 * size, 0.35 * size, 0.3 * size];
        self.block(base + Vec3A::Z * (half[2] - 0.2 * size), [half[0], half[1], half[2] + 0.2 * size], heading, walls);
        let turn = Mat3A::from_rotation_z(heading);
        for side in [-1.0, 1.0] {
            let rotation = turn * Mat3A::from_rotation_x(-side * 0.6);
            let center = base + turn * Vec3A::new(0.0, side * 0.2 * size, 0.73 * size);
            self.put(Shape::Box { half: Vec3A::new(0.55, 0.29, 0.02) * size }, center, rotation, roof);
        }
        let pane = self.draw(Role::Glass);
        for (x, y) in [(-0.25, -1.0), (0.2, -1.0), (-0.1, 1.0)] {
            let center = base + turn * Vec3A::new(x * size, y * half[1], 0.3 * size);
            self.block(center, [0.07 * size, 0.01 * size, 0.09 * size], heading, pane);
        }
    }
}

/// z is the normal; y is up, or the world's y for a level surface.
pub(super) fn facing(normal: Vec3A) -> Mat3A {
    let up = if normal.z.abs() > 0.9 { Vec3A::Y } else { Vec3A::Z };
    let x = up.cross(normal).normalize();
    Mat3A::from_cols(x, normal.cross(x), normal)
}
