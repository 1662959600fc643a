use crate::case::*;
use zipsplat::stages::loss::record_targets;

#[test]
fn parts_give_the_same_bits() {
    let photos: Vec<u32> = (0..3000u32).map(|i| i.wrapping_mul(0x9e37_79b9)).collect();
    let converted = |limits: &Limits| {
        let mut case = plan_within(limits);
        let words = case.input(&photos);
        let targets = record_targets(&mut case.rec, words, 4 * photos.len() - 1);
        case.result::<f32>(targets).unwrap()
    };
    let narrow = Limits { max_binding_bytes: 1024, ..device().limits().clone() };
    assert_same("photos in parts", &converted(&narrow), &converted(device().limits()));
}
