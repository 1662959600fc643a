use crate::case::*;
use zipsplat::kernels::render::Pack;
use zipsplat_tests::reference::render::pack::pack;

/// Around 0..1 off the rounding ties, and the range's ends.
fn frames(count: usize) -> Vec<[f32; 4]> {
    let mut frames: Vec<[f32; 4]> =
        random(7, 4 * count).chunks_exact(4).map(|p| [0, 1, 2, 3].map(|i| 0.5 + 0.75 * p[i])).collect();
    let ends = [[0.0, 1.0, -1.0, 2.0], [1e30, -1e30, f32::MIN_POSITIVE, -0.0]];
    frames.iter_mut().zip(ends).for_each(|(frame, end)| *frame = end);
    frames
}

#[test]
fn equals_the_reference() {
    for (count, blue_first) in [(0, false), (1, false), (2, true), (63, false), (65, true), (64 * 65_537, false)] {
        let frames = frames(count);
        let mut case = plan();
        let packed = case.output::<u32>(count);
        let kernel = Pack { frames: case.input(&frames), packed, count: count as u32, blue_first };
        case.rec.dispatch(kernel, count);
        let wide: Vec<[f64; 4]> = frames.iter().map(|pixel| pixel.map(f64::from)).collect();
        let found: Vec<[u8; 4]> = case.result(packed).unwrap();
        assert_same(&format!("{count} pixels"), found.as_flattened(), pack(&wide, blue_first).as_flattened());
    }
}
