//! First tokens, exact: one rounding a sum.

use crate::case::*;
use zipsplat::kernels::backbone::Tokens;
use zipsplat_tests::reference::backbone::tokens::tokens;

#[test]
fn equals_the_reference() {
    // The last exceeds 65,535 workgroups.
    for (views, patches, width) in [(0, 4, 4), (1, 1, 1), (1, 6, 9), (2, 31, 1), (3, 5, 13), (9, 7281, 65)] {
        let all = random(1, views * patches * width);
        let (class, positions) = (random(2, width), random(3, (1 + patches) * width));
        let len = views * (1 + patches) * width;
        let mut case = plan();
        let out = case.output::<f32>(len);
        let kernel = Tokens {
            patches: case.input(&all),
            class_token: case.input(&class),
            positions: case.input(&positions),
            out,
            views: views as u32,
            tokens: 1 + patches as u32,
            width: width as u32,
        };
        case.rec.dispatch(kernel, len);
        let truth = rounded(&tokens(&widen(&all), &widen(&class), &widen(&positions)));
        assert_same(&format!("{views} views of {patches} x {width}"), &case.result::<f32>(out).unwrap(), &truth);
    }
}
