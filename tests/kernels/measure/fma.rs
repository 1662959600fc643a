use crate::case::*;
use zipsplat::ops::measure::FmaChains;
use zipsplat_tests::reference::measure::fma::chains;

fn found(of: FmaChains) -> Vec<f32> {
    let mut case = plan();
    let out = of.record(&mut case.rec);
    case.result(out).unwrap()
}

fn truth(of: FmaChains) -> Vec<f64> {
    let steps = u64::from(of.iterations * FmaChains::STEPS);
    let starts =
        |thread: usize| (0..FmaChains::CHAINS).map(move |chain| (thread % 16) as f64 + 16.0 * f64::from(chain));
    let result = |thread| chains(starts(thread), steps, of.factor.into(), of.term.into());
    (0..of.threads).map(result).collect()
}

#[test]
fn every_step_is_done() {
    for (threads, iterations) in [(0, 1), (1, 0), (1, 1), (63, 3), (65, 70_000 / FmaChains::STEPS), (1 << 17, 2)] {
        for (factor, term) in [(1.0, 0.0625), (-1.0, 2.0)] {
            let of = FmaChains { threads, iterations, factor, term };
            assert_same(&format!("{of:?}"), &found(of), &rounded(&truth(of)));
        }
    }
}

#[test]
fn factor_and_term_are_what_they_are_said_to_be() {
    let of = FmaChains { threads: 100, iterations: 5, factor: 0.97, term: 0.3 };
    // Each of 40 steps rounds twice; early roundings shrink.
    assert_close("shrinking chains", &found(of), &truth(of), Tolerance::sum_of(2 * 40));
}

#[test]
fn work_is_counted() {
    let of = FmaChains { threads: 10, iterations: 3, factor: 1.0, term: 1.0 };
    assert_eq!(of.flops(), 10 * 3 * 2 * u64::from(FmaChains::CHAINS * FmaChains::STEPS));
}
