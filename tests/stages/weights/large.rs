use super::{assert_same_bits, pico};
use zipsplat::weights::convert;
use zipsplat_tests::prelude::*;

/// `vitg`'s 907 tensors at [`pico`]'s widths.
fn thin_giant() -> Architecture {
    let giant = Architecture::named("vitg").unwrap();
    let Architecture { depth, alt_start, qk_norm_start, rope_start, out_layers, ffn, camera_depth, .. } = giant;
    let name = "thin_giant".into();
    Architecture { name, depth, alt_start, qk_norm_start, rope_start, out_layers, ffn, camera_depth, ..pico() }
}

#[test]
fn every_type_is_written_and_converted() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first.safetensors"), folder.path().join("second.safetensors"));
    let giant = Checkpoint::seeded_architecture(thin_giant(), "thin_giant").unwrap();
    assert_eq!(giant.parameters().len(), 907);
    for dtype in [Dtype::F32, Dtype::F16, Dtype::Bf16] {
        giant.save(&first, dtype).unwrap();
        let header = u64::from_le_bytes(std::fs::read(&first).unwrap()[..8].try_into().unwrap());
        assert!(header > 1 << 16 && header.is_multiple_of(8), "{header}");
        convert(&first, &second, dtype, None).unwrap();
        assert_same_bits(&Checkpoint::open(&second, None).unwrap(), &giant);
    }
}
