use crate::case::*;
use zipsplat::refine::{Adam, Rate, Space, record_adam};

const ADAM: Adam = Adam { beta1: 0.9, beta2: 0.999, eps: 1e-8 };
const RATES: [f32; 2] = [0.02, 0.5]; // schedule, tensor
const SPACES: [Space; 3] = [Space::Linear, Space::Log, Space::Logit];

fn stepped(
    limits: &Limits,
    rate: impl Into<Rate>,
    space: Space,
    start: &[f32],
    gradients: &[Vec<f32>],
) -> [Vec<f32>; 3] {
    let rate = rate.into();
    let mut case = plan_within(limits);
    let (parameters, zeros) = (case.input(start), vec![0.0f32; start.len()]);
    let moments = [case.input(&zeros), case.input(&zeros)];
    for (step, gradient) in (1..).zip(gradients) {
        let (gradient, schedule) = (case.input(gradient), case.input(&ADAM.schedule(RATES[0], step)));
        record_adam(&mut case.rec, ADAM, parameters, gradient, moments, schedule, rate, space, start.len());
    }
    case.results([parameters, moments[0], moments[1]]).unwrap()
}

/// Values are valid in every space; 20 gradients have many magnitudes.
fn problem(count: usize) -> (Vec<f32>, Vec<Vec<f32>>) {
    let start = random(1, count).iter().map(|x| 0.5 + 0.49 * x).collect();
    let sizes = random(2, count);
    let gradient = |seed| random(seed, count).iter().zip(&sizes).map(|(x, size)| x * (9.0 * size).exp()).collect();
    (start, (10..30).map(gradient).collect())
}

#[test]
fn parts_give_the_same_bits() {
    let narrow = Limits { max_binding_bytes: 512, ..device().limits().clone() };
    let (start, gradients) = problem(1000);
    for space in SPACES {
        let [got, truth] =
            [&narrow, device().limits()].map(|limits| stepped(limits, RATES[1], space, &start, &gradients));
        for (got, truth) in got.iter().zip(&truth) {
            assert_same(&format!("{space:?} in parts"), got, truth);
        }
    }
}

#[test]
fn rows_step_at_two_rates() {
    let narrow = Limits { max_binding_bytes: 512, ..device().limits().clone() };
    let (start, gradients) = problem(1200);
    let at = |rate: Rate, limits: &Limits| stepped(limits, rate, Space::Linear, &start, &gradients)[0].clone();
    let [first, others] = [0.5f32, 0.05].map(|rate| at(rate.into(), device().limits()));
    let expected: Vec<f32> = (0..1200).map(|i| if i % 12 < 3 { first[i] } else { others[i] }).collect();
    for limits in [device().limits(), &narrow] {
        assert_same("rows of 12", &at(Rate { first: 0.5, others: 0.05, width: 12 }, limits), &expected);
    }
}

#[test]
fn values_stay_in_their_range() {
    let push = |space, start: f32, gradient: f32| {
        let mut case = plan();
        let [parameters, gradient, first, second] = [start, gradient, 0.0, 0.0].map(|value| case.input(&[value]));
        let schedule = case.input(&ADAM.schedule(1e4, 1));
        record_adam(&mut case.rec, ADAM, parameters, gradient, [first, second], schedule, 1.0, space, 1);
        case.result::<f32>(parameters).unwrap()[0]
    };
    assert_eq!([push(Space::Log, 1.0, 1.0), push(Space::Log, 1.0, -1.0)], [1e-30, 1e30]);
    assert_eq!([push(Space::Logit, 0.5, 1.0), push(Space::Logit, 1.0, -1.0)], [1e-6, 1.0 - 1e-6]);
    let back = widen(&[push(Space::Logit, 1.0, 1.0), push(Space::Logit, 0.0, -1.0)]);
    assert!(back[0] < 0.5 && back[1] > 0.5, "values at an end come back: {back:?}");
}
