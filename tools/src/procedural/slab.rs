use glam::Vec3A;

/// Kay and Kajiya's slabs. For rays along a face, min and max drop NaN.
pub(super) fn slab(origin: Vec3A, direction: Vec3A, half: Vec3A) -> Option<[f32; 2]> {
    let inverse = direction.recip();
    let (a, b) = ((-half - origin) * inverse, (half - origin) * inverse);
    let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
    (enter <= leave).then_some([enter, leave])
}
