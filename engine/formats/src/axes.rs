//! Conversion of the engine's axes (x right, y down, z forward) to y up.
//!
//! Both are half turns and their own inverse. About x: x right, y up, z backward (SPZ, OpenGL).
//! About z: x left, y up, z forward (glTF).

#[derive(Clone, Copy)]
pub enum HalfTurn {
    AboutX,
    AboutZ,
}

impl HalfTurn {
    pub fn point(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        match self {
            Self::AboutX => [x, -y, -z],
            Self::AboutZ => [-x, -y, z],
        }
    }

    pub fn quat(self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        let [x, y, z] = self.point([x, y, z]);
        [w, x, y, z]
    }

    /// With `k = l (l + 1) + m`, negating y negates negative m, negating z odd l + m; a half turn
    /// about z negates odd m.
    pub fn sh(self, k: usize) -> f32 {
        let l = k.isqrt();
        let (order, negative) = (k.abs_diff(l * (l + 1)), k < l * (l + 1));
        let negates = match self {
            Self::AboutX => negative != ((l + order) % 2 == 1),
            Self::AboutZ => order % 2 == 1,
        };
        if negates { -1.0 } else { 1.0 }
    }
}
