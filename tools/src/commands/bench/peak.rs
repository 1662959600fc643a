use super::{Repeats, Spread, timed_device};
use crate::{
    session::{Session, Stage},
    table::Table,
};
use clap::Args;
use serde::Serialize;
use std::{
    fmt,
    time::{Duration, Instant},
};
use zipsplat::{
    Result,
    gpu::{Device, Element, ProfileRow, Recorder, Run, Tensor},
    ops::{
        Arithmetic, Units,
        measure::{self, FmaChains, MatrixProducts},
    },
};
use zipsplat_reference::measure::{fma::chains, matrix::products};

/// Bytes of the copy, beyond all caches.
const COPIED: u64 = 512 << 20;
/// Warm-up to the sustained clock.
const WAKING: Duration = Duration::from_millis(500);
/// Shortest dispatch; dispatches take at most twice this.
const LONG_ENOUGH: Duration = Duration::from_millis(20);
/// Keeps sums exact.
const MOST_ITERATIONS: u32 = 1 << 18;
/// Fills a GPU or CPU.
const THREADS: [usize; 2] = [1 << 22, 1 << 14];
/// Fills the matrix units.
const SUBGROUPS: [usize; 2] = [1 << 15, 1 << 12];
/// Relative to the largest value; results are exact by construction.
const EQUAL: f64 = 1e-3;
pub const BRIEFLY: Repeats = Repeats { warmup: 1, repeats: 5 };

/// Peak rates of this device: f32 multiply-add, matrix units, and copies
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat bench peak
  zipsplat bench peak --json

Arithmetic runs in registers, in dispatches of 20 to 40 ms, and is compared with f64.
Bandwidth is that of a copy and counts bytes read and written. bench forward and
render report their rates relative to these.")]
pub struct Peak {
    #[command(flatten)]
    repeats: Repeats,
}

#[derive(Clone, Debug, Serialize)]
pub struct Rate {
    pub what: String,
    /// Median GFLOP (also for integers), or GB read and written.
    pub per_s: f64,
    pub unit: &'static str,
    ms: Spread,
    difference: f64,
}

impl Peak {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let device = timed_device(session)?;
        let mut rates = vec![session.stage("FMA", |stage| fma(&device, self.repeats, stage))?.0];
        for units in Element::FACTORS.into_iter().filter_map(|factor| Units::of(factor, device.limits())) {
            rates.push(session.stage("matrices", |stage| matrices(&device, units, self.repeats, stage))?.0);
        }
        rates.push(session.stage("copies", |stage| copies(&device, self.repeats, stage))?.0);
        let mut table = Table::new(1, &["limit", "rate", "", "ms: median (min..max)"]);
        for rate in &rates {
            table.row([rate.what.clone(), format!("{:.1}", rate.per_s), rate.unit.into(), rate.ms.to_string()]);
        }
        for rate in rates.iter().filter(|rate| rate.difference > EQUAL || rate.difference.is_nan()) {
            session.note(format!("{} gave a wrong result: its rate means nothing", rate.what));
            session.code = 5;
        }
        session.report(&rates, format!("{}\n{table}", device.limits().name))
    }
}

impl fmt::Display for Rate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {:.1} {}", self.what, self.per_s, self.unit)
    }
}

impl Rate {
    pub fn share(&self, per_s: f64) -> Option<f64> {
        (per_s > 0.0).then(|| per_s / self.per_s)
    }
}

/// Measures the fastest matrix units, or else lanes.
pub fn of_products(device: &Device, arithmetic: Arithmetic, repeats: Repeats, stage: &Stage<'_>) -> Result<Rate> {
    match arithmetic.quantized.or(arithmetic.linear) {
        Some(units) => matrices(device, units, repeats, stage),
        None => fma(device, repeats, stage),
    }
}

pub fn fma(device: &Device, repeats: Repeats, stage: &Stage<'_>) -> Result<Rate> {
    // Compilers do not know the factor.
    let of = |iterations| FmaChains { threads: pick(THREADS, device), iterations, factor: 1.0, term: 0.0625 };
    let record = |rec: &mut Recorder, iterations| (of(iterations).record(rec), Vec::new());
    let (iterations, ms, found) = sustained(device, repeats, stage, record)?;
    let of = of(iterations);
    let steps = u64::from(iterations) * u64::from(FmaChains::STEPS);
    let starts = |thread: u32| (0..FmaChains::CHAINS).map(move |chain| f64::from(thread + 16 * chain));
    let truth: Vec<f64> =
        (0..16).map(|thread| chains(starts(thread), steps, of.factor.into(), of.term.into())).collect();
    Ok(Rate {
        what: "multiply-add, f32".into(),
        per_s: ms.rate(of.flops()),
        unit: "GFLOP/s",
        ms,
        difference: difference(&found.into_iter().map(f32::from_bits).collect::<Vec<_>>(), &truth),
    })
}

fn matrices(device: &Device, units: Units, repeats: Repeats, stage: &Stage<'_>) -> Result<Rate> {
    let [m, n, k] = [units.shape.m, units.shape.n, units.shape.k].map(|side| side as usize);
    // Small integers are exact in every type.
    let whole = |len: usize| -> Vec<f32> { (0..len).map(|i| (i * i % 11 % 9) as f32 - 4.0).collect() };
    let (a, b) = (whole(2 * m * k), whole(MatrixProducts::products(device.limits()) * k * n));
    let of = |iterations| MatrixProducts { units, subgroups: pick(SUBGROUPS, device), iterations, swaps: 0 };
    let record = |rec: &mut Recorder, iterations| {
        let mut input = |values: &[f32]| {
            let bytes = units.factor.encode(values);
            (rec.constant::<u8>("factor", bytes.len()), bytes)
        };
        let (a, b) = (input(&a), input(&b));
        (of(iterations).record(rec, a.0, b.0), vec![a, b])
    };
    let (iterations, ms, found) = sustained(device, repeats, stage, record)?;
    let of = of(iterations);
    let [a, b] = [a, b].map(|values| values.into_iter().map(f64::from).collect::<Vec<_>>());
    let truth = products(&a, &b, [m, n, k], iterations, of.swaps);
    Ok(Rate {
        what: format!("matrices {m}x{n}x{k}, {}", units.factor.name()),
        per_s: ms.rate(of.flops(device.limits())),
        unit: "GFLOP/s",
        ms,
        difference: difference(&of.sums(found), &truth),
    })
}

pub fn copies(device: &Device, repeats: Repeats, stage: &Stage<'_>) -> Result<Rate> {
    let len = (COPIED.min(device.limits().max_binding_bytes) / 16 * 16) as usize;
    let mut rec = Recorder::new(device.limits());
    let from = rec.tensor::<u8>("from", len);
    rec.fill(from, 0x0101_0101);
    let to = measure::copy(&mut rec, from);
    rec.output(to);
    let mut run = Run::new(device, rec.finish()?)?;
    let ms = timed(device, &mut run, repeats, stage, |row| row.kernel == "measure/copy")?;
    let wrong = run.read::<u8>(to)?.iter().filter(|byte| **byte != 1).count();
    let per_s = 2.0 * len as f64 / (1e6 * ms.median.max(1e-6));
    Ok(Rate { what: "copy".into(), per_s, unit: "GB/s", ms, difference: wrong as f64 })
}

fn timed(
    device: &Device,
    run: &mut Run,
    Repeats { warmup, repeats }: Repeats,
    stage: &Stage<'_>,
    counted: impl Fn(&ProfileRow) -> bool,
) -> Result<Spread> {
    let started = Instant::now();
    let mut warmed = 0;
    let mut times = Vec::new();
    while times.len() < repeats as usize {
        stage.reach(times.len() as f64 / f64::from(repeats))?;
        let profile = run.profile()?;
        if warmed < warmup || (!device.limits().cpu && started.elapsed() < WAKING && times.is_empty()) {
            warmed += 1;
            continue;
        }
        times.push(profile.rows.iter().filter(|row| counted(row)).map(|row| row.time).sum());
    }
    Ok(Spread::of(times))
}

type Recorded = (Tensor, Vec<(Tensor, Vec<u8>)>);

/// Raises the iterations up to [`LONG_ENOUGH`].
fn sustained(
    device: &Device,
    repeats: Repeats,
    stage: &Stage<'_>,
    record: impl Fn(&mut Recorder, u32) -> Recorded,
) -> Result<(u32, Spread, Vec<u32>)> {
    let mut iterations = 1;
    loop {
        stage.reach(0.0)?;
        let mut rec = Recorder::new(device.limits());
        let (out, inputs) = record(&mut rec, iterations);
        rec.output(out);
        let mut run = Run::new(device, rec.finish()?)?;
        for (tensor, bytes) in &inputs {
            run.write(*tensor, bytes)?;
        }
        // A CPU driver compiles on the first run.
        run.profile()?;
        if run.profile()?.total("").0 < LONG_ENOUGH && iterations < MOST_ITERATIONS {
            iterations *= 2;
            continue;
        }
        return Ok((iterations, timed(device, &mut run, repeats, stage, |_| true)?, run.read(out)?));
    }
}

fn pick([gpu, cpu]: [usize; 2], device: &Device) -> usize {
    if device.limits().cpu { cpu } else { gpu }
}

/// `truth` repeats; NaN stays NaN.
fn difference(found: &[f32], truth: &[f64]) -> f64 {
    let most = |most: f64, value: f64| if value > most || value.is_nan() { value } else { most };
    let largest = truth.iter().map(|value| value.abs()).fold(0.0, most);
    found.iter().zip(truth.iter().cycle()).map(|(x, y)| (f64::from(*x) - y).abs()).fold(0.0, most) / largest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_result_is_seen_wherever_it_is() {
        let truth = [2.0, -4.0];
        assert_eq!(difference(&[2.0, -4.0, 2.0, -4.0], &truth), 0.0);
        assert_eq!(difference(&[2.0, -4.0, 2.0, -3.0], &truth), 0.25);
        assert!(difference(&[f32::NAN, -4.0, 2.0, -4.0], &truth).is_nan());
    }
}
