//! Adam steps: all spaces against the formulas on ln p and logit p, and non-finite values.

use crate::case::{Case, random};
use zipsplat::gpu::Limits;
use zipsplat::refine::{Adam, Space, record_adam};
use zipsplat_tests::compare::{Tolerance, assert_close, assert_same};
use zipsplat_tests::device::device;
use zipsplat_tests::reference::{refine::adam::Adam as Reference, widen};

const ADAM: Adam = Adam { beta1: 0.9, beta2: 0.999, eps: 1e-8 };
const RATES: [f32; 2] = [0.02, 0.5]; // schedule, tensor
const SPACES: [Space; 3] = [Space::Linear, Space::Log, Space::Logit];

/// Returns values and moments after a step with each of `gradients`.
fn stepped(limits: &Limits, space: Space, start: &[f32], gradients: &[Vec<f32>]) -> [Vec<f32>; 3] {
    let mut case = Case::within(limits);
    let (parameters, zeros) = (case.input(start), vec![0.0f32; start.len()]);
    let moments = [case.input(&zeros), case.input(&zeros)];
    for (step, gradient) in (1..).zip(gradients) {
        let (gradient, schedule) = (case.input(gradient), case.input(&ADAM.schedule(RATES[0], step)));
        record_adam(&mut case.rec, ADAM, parameters, gradient, moments, schedule, RATES[1], space, start.len());
    }
    let tensors = [parameters, moments[0], moments[1]];
    tensors.iter().for_each(|tensor| case.rec.output(*tensor));
    let run = case.run();
    tensors.map(|tensor| run.read(tensor).unwrap())
}

/// Returns the map to the steps' space, its inverse, and the inverse's derivative.
fn maps(space: Space) -> [fn(f64) -> f64; 3] {
    match space {
        Space::Linear => [|p| p, |x| x, |_| 1.0],
        Space::Log => [f64::ln, f64::exp, f64::exp],
        Space::Logit => [|p| (p / (1.0 - p)).ln(), |x| 1.0 / (1.0 + (-x).exp()), |x| 0.25 / (x / 2.0).cosh().powi(2)],
    }
}

fn truth(space: Space, start: &[f32], gradients: &[Vec<f32>]) -> [Vec<f64>; 3] {
    let [there, back, slope] = maps(space);
    let betas = [ADAM.beta1, ADAM.beta2].map(f64::from);
    let rate = RATES.iter().map(|&rate| f64::from(rate)).product::<f64>();
    let of = |i: usize| {
        let first = Reference { value: there(f64::from(start[i])), ..Reference::default() };
        (1..).zip(gradients).fold(first, |state, (step, gradient)| {
            state.stepped(f64::from(gradient[i]) * slope(state.value), step, rate, betas, f64::from(ADAM.eps))
        })
    };
    let states: Vec<Reference> = (0..start.len()).map(of).collect();
    let field = |get: fn(&Reference) -> f64| states.iter().map(get).collect();
    [states.iter().map(|state| back(state.value)).collect(), field(|s| s.moments[0]), field(|s| s.moments[1])]
}

/// Returns `count` values valid in every space, and 20 gradients of many magnitudes.
fn problem(count: usize) -> (Vec<f32>, Vec<Vec<f32>>) {
    let start = random(1, count).iter().map(|x| 0.5 + 0.49 * x).collect();
    let sizes = random(2, count);
    let gradient = |seed| random(seed, count).iter().zip(&sizes).map(|(x, size)| x * (9.0 * size).exp()).collect();
    (start, (10..30).map(gradient).collect())
}

#[test]
fn twenty_steps_in_every_space() {
    for space in SPACES {
        for count in [0, 1, 65, 1001] {
            let (start, gradients) = problem(count);
            let got = stepped(device().limits(), space, &start, &gradients);
            let truth = truth(space, &start, &gradients);
            for ((name, got), truth) in ["values", "first", "second"].iter().zip(&got).zip(&truth) {
                // Each step rounds; sums of both signs in the first moment cancel.
                let tolerance = Tolerance::EXPONENTIAL;
                assert_close(&format!("{name} of {count} in {space:?}"), got, truth, tolerance);
            }
        }
    }
}

#[test]
fn parts_give_the_same_bits() {
    let narrow = Limits { max_binding_bytes: 512, ..device().limits().clone() };
    let (start, gradients) = problem(1000);
    for space in SPACES {
        let [got, truth] = [&narrow, device().limits()].map(|limits| stepped(limits, space, &start, &gradients));
        for (got, truth) in got.iter().zip(&truth) {
            assert_same(&format!("{space:?} in parts"), got, truth);
        }
    }
}

#[test]
fn no_gradient_moves_nothing_and_no_finite_one_changes_nothing() {
    let start = [0.25f32, 0.5, 0.75, 0.125, 0.5];
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e38, 0.0];
    for space in SPACES {
        let [good, then] = [vec![vec![1.0f32; 5]], vec![vec![1.0; 5], bad.to_vec()]]
            .map(|gradients| stepped(device().limits(), space, &start, &gradients));
        for (after, before) in then.iter().zip(&good) {
            assert_same(&format!("{space:?}"), &after[..4], &before[..4]);
        }
        let still = stepped(device().limits(), space, &start, &[vec![0.0; 5]]);
        assert_same(&format!("{space:?} without a gradient"), &still[0], &start);
    }
}

#[test]
fn values_stay_in_their_range() {
    let push = |space, start: f32, gradient: f32| {
        let huge = vec![vec![gradient]; 1];
        let mut case = Case::new();
        let tensors = [vec![start], huge[0].clone(), vec![0.0], vec![0.0]].map(|values| case.input(&values));
        let [parameters, gradient, first, second] = tensors;
        let schedule = case.input(&ADAM.schedule(1e4, 1));
        record_adam(&mut case.rec, ADAM, parameters, gradient, [first, second], schedule, 1.0, space, 1);
        case.rec.output(parameters);
        case.result::<f32>(parameters)[0]
    };
    assert_eq!([push(Space::Log, 1.0, 1.0), push(Space::Log, 1.0, -1.0)], [1e-30, 1e30]);
    assert_eq!([push(Space::Logit, 0.5, 1.0), push(Space::Logit, 1.0, -1.0)], [1e-6, 1.0 - 1e-6]);
    let back = widen(&[push(Space::Logit, 1.0, 1.0), push(Space::Logit, 0.0, -1.0)]);
    assert!(back[0] < 0.5 && back[1] > 0.5, "values at an end come back: {back:?}");
}
