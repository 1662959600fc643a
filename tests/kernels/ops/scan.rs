//! Prefix sums against a running sum on the host.

use zipsplat::{
    gpu::{Recorder, Run},
    ops::scan::exclusive_scan,
};
use zipsplat_tests::{compare::assert_same, device::device};

#[test]
fn equals_the_running_sum() {
    for count in [0, 1, 7, 8, 9, 255, 256, 257, 1023, 1024, 1025, 65_537, 1_000_003] {
        // Large enough to wrap at 2^32.
        let values: Vec<u32> = (0..count as u32).map(|i| i.wrapping_mul(2_654_435_761) >> (i % 32)).collect();
        let mut rec = Recorder::new(device().limits());
        let tensor = rec.input::<u32>("values", count.max(1));
        exclusive_scan(&mut rec, tensor, count);
        rec.output(tensor);
        let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
        run.write(tensor, if count == 0 { &[0] } else { &values }).unwrap();
        run.execute().unwrap();
        let running = values.iter().scan(0u32, |sum, value| {
            let before = *sum;
            *sum = sum.wrapping_add(*value);
            Some(before)
        });
        let truth: Vec<u32> = running.collect();
        assert_same(&format!("{count} values"), &run.read::<u32>(tensor).unwrap()[..count], &truth);
    }
}
