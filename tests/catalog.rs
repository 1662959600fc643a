use crate::device::device;
use zipsplat_verify::{catalog, shapes};

/// Asserts the bounds of kernels whose name starts with `family`.
pub fn examine(family: &str) {
    let mut outside = Vec::new();
    let mut count = 0;
    for area in catalog().into_iter().chain(shapes()).filter(|area| area.kernel.starts_with(family)) {
        for (case, mode) in area.on(device().limits()) {
            let found = area.examine(case, device(), mode).unwrap();
            count += 1;
            let (mode, share) = (mode.name(), found.worst.share);
            println!("found: {}, {}, size {}, {mode}: {share:.2e} of the bound", found.kernel, found.case, found.size);
            if !found.holds || found.worst.typical > 1.0 {
                outside.push(format!(
                    "{} {mode} {}, size {}: {:?} {:?}",
                    found.kernel, found.case, found.size, found.worst, found.failed
                ));
            }
        }
    }
    assert!(count > 0, "no cases of {family}");
    assert!(outside.is_empty(), "outside their bounds:\n{}", outside.join("\n"));
}
