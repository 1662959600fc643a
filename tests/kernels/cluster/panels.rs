use crate::case::*;
use zipsplat::{kernels::cluster::Panels, kernels::limits::PANEL_COLUMNS};
use zipsplat_tests::reference::cluster::panels::panels;

#[test]
fn lie_side_by_side() {
    for (rows, width) in [(1, 4), (31, 12), (32, 8), (33, 4), (100, 20)] {
        let values = random(1, rows * width);
        let truth = panels(&values, width, PANEL_COLUMNS as usize);
        let mut case = plan();
        let out = case.output::<f32>(truth.len());
        let kernel = Panels { source: case.input(&values), out, rows: rows as u32, width: width as u32 };
        case.rec.dispatch(kernel, truth.len());
        assert_same(&format!("{rows} x {width}"), &case.result::<f32>(out).unwrap(), &truth);
    }
}
