use crate::device::device;
use std::thread;
use zipsplat_verify::{catalog, shapes};

/// Asserts the bounds of kernels whose name starts with `family`.
pub fn examine(family: &str) {
    let found = thread::scope(|scope| {
        let workers = [0, 1].map(|worker| scope.spawn(move || examine_share(family, worker)));
        workers.map(|worker| worker.join().expect("a worker ends"))
    });
    assert!(found.iter().map(|(count, _)| count).sum::<usize>() > 0, "no cases of {family}");
    let outside = found.map(|(_, outside)| outside).concat();
    assert!(outside.is_empty(), "outside their bounds:\n{}", outside.join("\n"));
}

/// Every second mode. Returns the number of cases, and those outside.
fn examine_share(family: &str, worker: usize) -> (usize, Vec<String>) {
    let (mut count, mut outside) = (0, Vec::new());
    let areas = catalog().into_iter().chain(shapes()).filter(|area| area.kernel.starts_with(family));
    for area in areas {
        let modes = area.supported_modes(device().limits()).skip(worker).step_by(2);
        for (mode, case) in modes.flat_map(|mode| area.cases.iter().map(move |case| (mode, case))) {
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
    (count, outside)
}
