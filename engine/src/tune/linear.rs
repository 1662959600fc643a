use super::{
    COLUMNS, Candidate, Operation, TERMS, kernel_name,
    noise::{encoded_noise, noise},
    self_test::{deviation, worse},
};
use crate::{
    Result,
    gpu::{Device, Element, Recorder, Run, Tensor},
    ops::{
        Activation, Arithmetic, Epilogue, LaneTile, Lanes, Linear, LinearKernel, Q8, Rows, Tile, Tiles, Weights,
        pack_matrix,
    },
};

/// Only the order of sums differs.
const LIMIT: f64 = 1e-3;

pub(super) const LINEAR: Operation = Operation {
    name: "linear",
    lanes: &[Element::F16, Element::Bf16, Element::I8],
    factors: &Element::FACTORS,
    tiles: Tile::linear,
    lane_tiles: LaneTile::candidates,
    kernels,
    deviation: linear_deviation,
    timed,
    chosen: |arithmetic| vec![&mut arithmetic.linear, &mut arithmetic.quantized],
    chosen_on_lanes,
};

/// For f32 results, and for results that only feed products.
fn kernels(on_units: bool, factor: Element) -> Vec<(String, Element)> {
    let base = if factor == Element::I8 && !on_units { "ops/linear_dot" } else { "ops/linear" };
    let name = kernel_name(base, on_units, factor);
    let own = if factor == Element::I8 { Element::F16 } else { factor };
    let outputs = [Element::F32].into_iter().chain((own != Element::F32).then_some(own));
    outputs.map(|output| (format!("{name}_{}", output.name()), output)).collect()
}

/// f32 must match bit for bit: all tiles add in one order.
fn linear_deviation(device: &Device, candidate: Candidate, output: Element) -> Result<Option<f64>> {
    // Several workgroups per axis, the last partial.
    let [rows, columns] = match candidate {
        Candidate::Lanes(_, Some(tile)) => tile.sides.map(|side| side as usize),
        Candidate::Lanes(..) => [32, 32],
        Candidate::Units(units, tile) => tile.sides(units),
    };
    let (kernel, rows, columns) = (kernel(candidate), rows + 3, columns + 8);
    // Partial steps of the sums, sums in parts, whole steps.
    let mut cases = vec![(Activation::None, kernel, 72), (Activation::Gelu, kernel, 2048)];
    cases.extend(columns.is_multiple_of(8).then_some((Activation::SwiGlu, kernel, 128)));
    cases.extend(kernel.with_q8().map(|q8| (Activation::None, q8, 96)));
    let mut worst = Some(0.0);
    for (activation, kernel, inner) in cases {
        let product = |variant, output: Element| -> Result<Vec<f32>> {
            let layer = Layer { kernel: variant, sizes: [rows, inner, columns], activation, output };
            let (mut run, out) = layer.run(device, kernel)?;
            run.execute()?;
            Ok(output.decode(&run.read::<u8>(out)?))
        };
        let exact = LinearKernel::Panels(Lanes::of(Element::F32), Weights::Factors);
        let (exact, fast) = (product(exact, Element::F32)?, product(kernel, output)?);
        worst = worse(
            worst,
            match kernel.factor() {
                Element::F32 => same_bits(&exact, &fast).then_some(0.0),
                _ => deviation(LIMIT, output.roundoff(), &exact, &fast),
            },
        );
    }
    Ok(worst)
}

fn timed(device: &Device, candidate: Candidate, rows: usize) -> Result<Run> {
    let kernel = kernel(candidate);
    let sizes = [rows, TERMS, COLUMNS];
    let layer = Layer { kernel, sizes, activation: Activation::None, output: kernel.element() };
    layer.run(device, kernel).map(|(run, _)| run)
}

fn chosen_on_lanes(arithmetic: &mut Arithmetic) -> Vec<(Element, &mut Tiles)> {
    let Arithmetic { element, tiles, exact_tiles, dots, .. } = arithmetic;
    let floats = [(*element, tiles), (Element::F32, exact_tiles)];
    floats.into_iter().chain(dots.as_mut().map(|tiles| (Element::I8, tiles))).collect()
}

fn kernel(candidate: Candidate) -> LinearKernel {
    match candidate {
        Candidate::Lanes(Lanes { element: Element::I8, tiles }, _) => LinearKernel::Dots(tiles),
        Candidate::Lanes(lanes, _) => LinearKernel::Panels(lanes, Weights::Factors),
        Candidate::Units(units, _) => LinearKernel::Matrix(units, Weights::Factors),
    }
}

fn same_bits(a: &[f32], b: &[f32]) -> bool {
    a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}

struct Layer {
    kernel: LinearKernel,
    /// Rows, terms of a sum, columns.
    sizes: [usize; 3],
    activation: Activation,
    output: Element,
}

impl Layer {
    fn run(&self, device: &Device, tested: LinearKernel) -> Result<(Run, Tensor)> {
        let ([rows, inner, columns], kernel, factor) = (self.sizes, self.kernel, tested.factor());
        let weight = match tested.weights() {
            Weights::Q8 => noise(2, columns * Q8::scales_of(inner), Q8::GROUP, Element::I8),
            Weights::Factors => noise(2, columns, inner, factor),
        };
        let packed = pack_matrix(kernel, &weight, inner, columns);
        let values = encoded_noise(1, rows, inner, factor, kernel.element());
        let mut rec = Recorder::new(device.limits());
        let (weight, bias) = (rec.constant::<u8>("weight", packed.len()), rec.constant::<f32>("bias", columns));
        let tensor = rec.constant::<u8>("input", values.len());
        let input = Rows { tensor, count: rows, width: inner, element: kernel.element() };
        let with_residual = self.activation == Activation::Gelu;
        let residual = with_residual.then(|| Rows::new(rec.constant::<f32>("residual", rows * columns), rows, columns));
        let gamma = residual.map(|_| bias);
        let epilogue = Epilogue { activation: self.activation, gamma, residual };
        let layer = Linear { weight, bias, inner, columns, kernel };
        let out = layer.apply(&mut rec, "out", input, self.output, epilogue).tensor;
        rec.output(out);
        let mut run = Run::new(device, rec.finish()?)?;
        run.write(weight, &packed)?;
        run.write(bias, &noise(3, 1, columns, factor))?;
        run.write(tensor, &values)?;
        if let Some(residual) = residual {
            run.write(residual.tensor, &noise(4, rows, columns, Element::F32))?;
        }
        Ok((run, out))
    }
}
