//! Fast kernels against their exact twins, once per device and driver, so that none is used where it computes wrongly.

mod nearest;
mod record;

pub(super) use record::{UNFINISHED, unfinished};

use super::{
    Activation, Arithmetic, Attention, AttentionKernel, Epilogue, Heads, Linear, LinearKernel, Part, Units,
    attention_tile::AttentionTile,
    pack_matrix,
    tile::{LinearTile, Tiles},
};
use crate::{
    Error, Result,
    gpu::{Device, Element, Recorder, Run, Tensor},
};
use std::collections::{BTreeMap, HashSet};

/// Largest deviation that passes, relative to the rms of the exact result. Both twins get the same factors, so a linear
/// layer differs by the order of its sums, attention by the rounding of queries, weights and results, which is this many
/// times the unit roundoff.
const LINEAR_LIMIT: f64 = 1e-3;
const ATTENTION_LIMIT: f64 = 40.0;

/// What the kernels of one device were found to do.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SelfTest {
    /// Largest deviation of each kernel that the device can run, by name and relative to what passes: above 1 it is not used.
    /// None where it gave no number.
    pub deviations: BTreeMap<String, Option<f64>>,
    /// Kernels that were tested before this run, which goes on with the others.
    #[serde(skip)]
    before: HashSet<String>,
}

impl SelfTest {
    /// Runs every fast kernel that the device can run.
    ///
    /// # Errors
    /// A failure of the device.
    pub fn run(device: &Device) -> Result<Self> {
        let mut test = Self::default();
        test.run_all(device).map(|()| test)
    }

    /// All that have not been tested yet.
    fn run_all(&mut self, device: &Device) -> Result<()> {
        let (test, limits) = (self, device.limits());
        test.before = test.deviations.keys().cloned().collect();
        if !limits.half_storage {
            return Ok(());
        }
        for element in Element::HALVES {
            test.linear(device, LinearKernel::Panels(element), [35, 40])?;
            test.attention(device, one_sequence(AttentionKernel::Lanes(element), 35), 1.0)?;
        }
        if let Some(units) = Units::of(Element::F16, limits) {
            test.nearest_tiles(device, units)?;
        }
        for factor in Element::FACTORS {
            let Some(units) = Units::of(factor, limits) else { continue };
            let tiles = LinearTile::candidates(limits, units);
            test.none_fits(&linear_name(LinearKernel::Matrix(units), Element::F32), tiles.is_empty());
            for (index, tile) in tiles.iter().enumerate() {
                test.tile(device, units, *tile, index)?;
            }
            if factor == Element::I8 {
                continue;
            }
            let widest = AttentionTile::candidates(limits, units, WIDEST_HEAD);
            test.none_fits(&attention_name(AttentionKernel::Matrix(units)), widest.is_empty());
            let tiles = AttentionTile::candidates(limits, units, AttentionTile::TUNED_CHANNELS);
            for (index, tile) in tiles.iter().enumerate() {
                let kernel = AttentionKernel::Matrix(Units { tiles: Tiles::always(index), ..units });
                test.attention(device, one_sequence(kernel, tile.rows(units.shape) + 3), 1.0)?;
            }
        }
        Ok(())
    }

    /// Runs the test of a kernel. One that a driver refuses, or that loses the device, gave no result; only what would stop the
    /// others, too, is an error.
    fn outcome(&mut self, kernel: &str, test: impl FnOnce(&mut Self) -> Result<()>) -> Result<()> {
        if self.before.contains(kernel) {
            return Ok(());
        }
        let outcome = test(self);
        if outcome.as_ref().is_err_and(|error| !matches!(error, Error::Memory { .. })) {
            self.found(kernel, None);
        }
        match outcome {
            Err(error @ (Error::DeviceLost | Error::Memory { .. })) => Err(error),
            _ => Ok(()),
        }
    }

    /// More than one workgroup each way, the last of them not whole.
    fn tile(&mut self, device: &Device, units: Units, tile: LinearTile, index: usize) -> Result<()> {
        let [rows, columns] = tile.sides(units.shape);
        let kernel = LinearKernel::Matrix(Units { tiles: Tiles::always(index), ..units });
        self.linear(device, kernel, [rows + 3, columns + 8])
    }

    /// An arithmetic without the matrix kernels that failed; `None` where those that would replace them failed, too.
    pub(super) fn allowed(&self, wanted: Arithmetic) -> Option<Arithmetic> {
        let element = wanted.element;
        let linear =
            |kernel: LinearKernel| outputs(kernel).iter().all(|output| self.passed(&linear_name(kernel, *output)));
        let passed = |units: &Units| linear(LinearKernel::Matrix(*units));
        let quantised = wanted.quantised.filter(passed);
        let usable = linear(LinearKernel::Panels(element))
            && self.passed(&attention_name(AttentionKernel::Lanes(element)))
            && quantised.is_some() == wanted.quantised.is_some();
        usable.then_some(Arithmetic {
            linear: wanted.linear.filter(passed),
            attention: wanted.attention.filter(|units| self.passed(&attention_name(AttentionKernel::Matrix(*units)))),
            nearest: wanted.nearest.filter(|_| self.passed(nearest::NAME)),
            ..wanted
        })
    }

    fn passed(&self, kernel: &str) -> bool {
        self.deviations.get(kernel).is_some_and(|deviation| passes(*deviation))
    }

    /// A kernel none of whose tiles is within the device's limits fails.
    fn none_fits(&mut self, kernel: &str, none: bool) {
        if none && !self.before.contains(kernel) {
            self.found(kernel, None);
        }
    }

    /// `stored` is the unit roundoff of what a kernel's results are kept in: Vulkan lets a device round to either neighbour.
    fn compare(&mut self, kernel: &str, limit: f64, stored: f64, exact: &[f32], fast: &[f32]) {
        let rms = (exact.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / exact.len() as f64).sqrt();
        let largest = exact.iter().fold(0.0, |most, x| f64::from(x.abs()).max(most));
        let limit = limit + 2.0 * stored * largest / rms;
        let apart = |(a, b): (&f32, &f32)| f64::from((a - b).abs());
        // Unlike f64::max, which loses NaN.
        let larger = |a: f64, b: f64| if a.is_nan() || b <= a { a } else { b };
        let worst = exact.iter().zip(fast).map(apart).fold(0.0, larger);
        let deviation = worst / rms / limit;
        self.found(kernel, deviation.is_finite().then_some(deviation));
    }

    /// Keeps the largest deviation of a kernel, over its tiles and problems.
    fn found(&mut self, kernel: &str, deviation: Option<f64>) {
        let worst = self.deviations.entry(kernel.into()).or_insert(deviation);
        *worst = worst.zip(deviation).map(|(a, b)| a.max(b));
    }

    fn linear(&mut self, device: &Device, kernel: LinearKernel, [rows, columns]: [usize; 2]) -> Result<()> {
        const INNER: usize = 72;
        let factor = kernel.factor();
        let (a, b, bias) =
            (noise(1, rows, INNER, factor), noise(2, columns, INNER, factor), noise(3, 1, columns, factor));
        let run = |kernel: LinearKernel, output: Element, what: Activation| -> Result<Vec<f32>> {
            let mut rec = Recorder::new(device.limits());
            let packed = pack_matrix(kernel, &b, INNER, columns);
            let (weight, bias_tensor) = (rec.constant::<u8>("weight", packed.len()), rec.input::<f32>("bias", columns));
            let input = rec.input::<u8>("input", a.len() * kernel.element().bytes());
            let layer = Linear { weight, bias: bias_tensor, inner: INNER, columns, kernel };
            let residual = (what == Activation::Gelu).then(|| rec.input::<f32>("residual", rows * columns));
            // The bias scales, too.
            let gamma = residual.map(|_| bias_tensor);
            let epilogue = Epilogue { activation: what, gamma, residual, output };
            let out = layer.apply(&mut rec, "out", input, rows, epilogue);
            rec.output(out);
            let mut run = Run::new(device, rec.finish()?)?;
            run.write(weight, &packed)?;
            run.write(bias_tensor, &bias)?;
            run.write(input, &kernel.element().encode(&a))?;
            if let Some(residual) = residual {
                run.write(residual, &noise(4, rows, columns, Element::F32))?;
            }
            run.execute()?;
            Ok(output.decode(&run.read::<u8>(out)?))
        };
        let mut activations = vec![Activation::None, Activation::Gelu];
        activations.extend(columns.is_multiple_of(8).then_some(Activation::SwiGlu));
        for output in outputs(kernel) {
            let name = linear_name(kernel, output);
            self.outcome(&name, |test| {
                for what in &activations {
                    let exact = run(LinearKernel::Panels(Element::F32), Element::F32, *what)?;
                    test.compare(&name, LINEAR_LIMIT, output.roundoff(), &exact, &run(kernel, output, *what)?);
                }
                Ok(())
            })?;
        }
        Ok(())
    }

    /// Scores `peaked` times as far apart as those of random queries and keys.
    fn attention(&mut self, device: &Device, attention: Attention, peaked: f32) -> Result<()> {
        let Attention { heads, sequences, queries, keys, kernel } = attention;
        let (width, element) = (heads.width(), kernel.element());
        let [queries, keys] = [queries, keys].map(|tokens| sequences * tokens);
        let parts = [(1, queries), (2, keys), (3, keys)].map(|(seed, tokens)| noise(seed, tokens, width, element));
        let run = |kernel: AttentionKernel| -> Result<Vec<f32>> {
            let (mut run, out) = attention_run(device, Attention { kernel, ..attention }, &parts, peaked)?;
            run.execute()?;
            Ok(kernel.element().decode(&run.read::<u8>(out)?))
        };
        let (name, limit) = (attention_name(kernel), ATTENTION_LIMIT * element.roundoff());
        self.outcome(&name, |test| {
            let (exact, fast) = (run(AttentionKernel::Lanes(Element::F32))?, run(kernel)?);
            test.compare(&name, limit, 0.0, &exact, &fast);
            Ok(())
        })
    }
}

/// A run of attention over queries, keys and values, and its result. Scores are `peaked` times what they are.
pub(super) fn attention_run(
    device: &Device,
    attention: Attention,
    parts: &[Vec<f32>; 3],
    peaked: f32,
) -> Result<(Run, Tensor)> {
    let (width, element) = (attention.heads.width(), attention.kernel.element());
    let mut rec = Recorder::new(device.limits());
    let inputs = [0, 1, 2].map(|i| rec.constant::<u8>("part", parts[i].len() * element.bytes()));
    let tensors = attention.tensors(&mut rec);
    let of_queries = Part { scale: peaked * attention.scale(), ..Part::default() };
    let kinds = [of_queries, Part { keys: true, ..Part::default() }, Part::default()];
    for i in 0..3 {
        attention.split(&mut rec, (inputs[i], width), 0, parts[i].len() / width, kinds[i], tensors[i]);
    }
    let out = attention.record(&mut rec, tensors);
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    for (input, values) in inputs.into_iter().zip(parts) {
        run.write(input, &element.encode(values))?;
    }
    Ok((run, out))
}

/// What a kernel's results are stored as: what goes on in f32, and what only feeds other products.
fn outputs(kernel: LinearKernel) -> [Element; 2] {
    [Element::F32, kernel.element()]
}

fn linear_name(kernel: LinearKernel, output: Element) -> String {
    let output = output.name();
    match kernel {
        LinearKernel::Panels(element) => format!("ops/linear_{}_{output}", element.name()),
        LinearKernel::Matrix(Units { factor, .. }) => format!("ops/linear_matrix_{}_{output}", factor.name()),
    }
}

fn attention_name(kernel: AttentionKernel) -> String {
    match kernel {
        AttentionKernel::Lanes(element) => format!("ops/attention_{}", element.name()),
        AttentionKernel::Matrix(Units { factor, .. }) => format!("ops/attention_matrix_{}", factor.name()),
    }
}

/// Channels of the largest heads, which take most shared memory.
const WIDEST_HEAD: usize = 128;

fn one_sequence(kernel: AttentionKernel, queries: usize) -> Attention {
    Attention { heads: Heads { count: 16, dim: 64 }, sequences: 1, queries, keys: 100, kernel }
}

/// Whether a deviation is one that may be.
pub(super) fn passes(deviation: Option<f64>) -> bool {
    deviation.is_some_and(|times| times <= 1.0)
}

/// `rows` of numbers in (-1, 1) that a type holds; of 128ths that keep their values when a row is scaled to whole numbers up to 127.
pub(super) fn noise(seed: u64, rows: usize, width: usize, element: Element) -> Vec<f32> {
    let mut state = seed << 40;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    let values: Vec<f32> = (0..rows * width).map(|_| next()).collect();
    match element {
        Element::I8 => {
            let whole = |(i, x): (usize, f32)| if i % width == 0 { 127.0 } else { (126.0 * x).round() };
            values.into_iter().enumerate().map(|value| whole(value) / 128.0).collect()
        }
        _ => element.decode(&element.encode(&values)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_agrees_passes() {
        let exact = [1.0, -1.0, 1.0];
        let passed = |fast: [f32; 3]| {
            let mut test = SelfTest::default();
            test.compare("kernel", 1e-3, 0.0, &exact, &fast);
            test.passed("kernel")
        };
        assert!(passed(exact) && passed([1.0009, -1.0, 1.0]));
        assert!(
            !passed([1.0011, -1.0, 1.0]) && !passed([f32::NAN, -1.0, 1.0]) && !passed([1.0, f32::INFINITY, f32::NAN])
        );
        assert!(!SelfTest::default().passed("kernel"), "what was not tested");
        let mut test = SelfTest::default();
        for fast in [exact, [f32::NAN; 3], exact] {
            test.compare("kernel", 1e-3, 0.0, &exact, &fast);
        }
        assert_eq!(test.deviations, [("kernel".to_owned(), None)].into(), "its worst result counts");
    }
}
