//! Between the engine's axes (x right, y down, z forward) and those of formats with y up. Either way is half a turn, which
//! is its own inverse: about x to x right, y up, z backward (SPZ, OpenGL); about z to x left, y up, z forward (glTF).
//! Standard deviations stay as they are.

/// Half a turn about an axis.
#[derive(Clone, Copy)]
pub enum HalfTurn {
    AboutX,
    AboutZ,
}

impl HalfTurn {
    /// A point or direction after the turn.
    pub fn point(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        match self {
            Self::AboutX => [x, -y, -z],
            Self::AboutZ => [-x, -y, z],
        }
    }

    /// A rotation `wxyz` after both frames that it maps between have turned: its axis turns.
    pub fn quat(self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        let [x, y, z] = self.point([x, y, z]);
        [w, x, y, z]
    }

    /// The factor of coefficient `k` of real spherical harmonics. With `k = l (l + 1) + m`, negating y negates
    /// harmonics of negative m, negating z those of odd l + m, and half a turn about z those of odd m.
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
