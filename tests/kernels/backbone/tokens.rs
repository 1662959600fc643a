//! First tokens, exact: one rounding a sum.

use crate::case::*;
use zipsplat::kernels::backbone::Tokens;
use zipsplat_tests::reference::backbone::tokens::tokens;

#[test]
fn equals_the_reference() {
    // (views, patches, width), (leading, kinds, reference); the last exceeds 65,535 workgroups.
    let shapes = [
        ((0, 4, 4), (1, 1, 0)),
        ((1, 1, 1), (1, 1, 0)),
        ((1, 6, 9), (5, 1, 0)),
        ((2, 31, 1), (5, 2, 1)),
        ((3, 5, 13), (3, 2, 0)),
        ((9, 7281, 65), (1, 1, 0)),
    ];
    for ((views, patches, width), (leading, kinds, reference)) in shapes {
        let all = random(1, views * patches * width);
        let (special, positions) = (random(2, kinds * leading * width), random(3, (leading + patches) * width));
        let (len, placed) = (views * (leading + patches) * width, kinds == 1);
        let mut case = plan();
        let out = case.output::<f32>(len);
        let kernel = Tokens {
            patches: case.input(&all),
            special: case.input(&special),
            positions: case.input(&positions),
            out,
            views: views as u32,
            tokens: (leading + patches) as u32,
            width: width as u32,
            leading: leading as u32,
            reference: reference as u32,
            others: kinds as u32 - 1,
            placed,
        };
        case.rec.dispatch(kernel, len);
        let (special, positions) = (widen(&special), widen(&positions));
        let kind = |kind: usize| &special[kind * leading * width..][..leading * width];
        let added = placed.then_some(&positions[..]);
        let truth = rounded(&tokens(&widen(&all), views, [kind(0), kind(kinds - 1)], reference, added));
        assert_same(&format!("{views} views of {patches} x {width}"), &case.result::<f32>(out).unwrap(), &truth);
    }
}
