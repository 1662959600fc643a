//! Patches, exactly.

use crate::case::{Case, random, rounded};
use zipsplat::kernels::backbone::Patchify;
use zipsplat_tests::compare::assert_same;
use zipsplat_tests::reference::{
    backbone::{patch_embed::Images, patchify::patchify},
    widen,
};

#[test]
fn equals_the_reference() {
    // (views, rows and columns of patches, patch); the last takes more than 65,535 workgroups.
    let shapes =
        [(0, 1, 1, 2), (1, 1, 1, 1), (1, 1, 1, 14), (2, 3, 5, 4), (3, 5, 2, 7), (1, 21, 1, 1), (2, 60, 60, 14)];
    for (views, rows, columns, patch) in shapes {
        let (height, width) = (rows * patch, columns * patch);
        let values = random(1, views * 3 * height * width);
        let mut case = Case::new();
        let out = case.output::<f32>(values.len());
        let kernel = Patchify {
            images: case.input(&values),
            out,
            views: views as u32,
            height: height as u32,
            width: width as u32,
            patch_size: patch as u32,
        };
        case.rec.dispatch(kernel, values.len());
        let truth = patchify(&Images { values: widen(&values), views, height, width }, patch);
        let name = format!("{views} views of {rows} x {columns} patches of {patch}");
        assert_same(&name, &case.result::<f32>(out), &rounded(&truth));
    }
}
