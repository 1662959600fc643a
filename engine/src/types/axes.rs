//! Between the engine's axes (x right, y down, z forward) and those of formats with y up (x right, y up, z backward,
//! as SPZ, glTF cameras and OpenGL have them): half a turn about x, which is its own inverse. Standard deviations stay.

/// A point or direction after the half turn.
pub fn turned_point([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x, -y, -z]
}

/// A rotation `wxyz` after the half turn: both frames that it maps between turn.
pub fn turned_quat([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [w, x, -y, -z]
}

/// What each coefficient of spherical harmonics up to degree 3 is multiplied with. Negating y negates the harmonics of
/// negative order m, negating z those of odd l + m.
pub const TURNED_SH: [f32; 16] =
    [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];
