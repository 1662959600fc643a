use super::{COLUMNS, Candidate, Operation, TERMS, kernel_name, noise::encoded_noise, self_test::deviation};
use crate::{
    Result,
    gpu::{Device, Element, Limits, Recorder, Run, Tensor},
    ops::{Attention, AttentionKernel, Heads, Part, Rows, Tile, Units},
};

/// Unit roundoffs, for rounded queries, weights and results.
const LIMIT: f64 = 40.0;

pub(super) const ATTENTION: Operation = Operation {
    name: "attention",
    lanes: &Element::HALVES,
    factors: &Element::HALVES,
    tiles,
    lane_tiles: |_, _| Vec::new(),
    kernels: |on_units, factor| vec![(kernel_name("ops/attention", on_units, factor), factor)],
    deviation: attention_deviation,
    timed: |device, candidate, rows| {
        attention(device, kernel(candidate), candidate.factor(), rows, TERMS).map(|(run, _)| run)
    },
    chosen: |arithmetic| vec![&mut arithmetic.attention],
    chosen_on_lanes: |_| Vec::new(),
};

fn tiles(limits: &Limits, units: Units) -> Vec<Tile> {
    let fits_all = !Tile::attention(limits, units, Tile::MOST_CHANNELS).is_empty();
    if fits_all { Tile::attention(limits, units, Tile::TUNED_CHANNELS) } else { Vec::new() }
}

fn attention_deviation(device: &Device, candidate: Candidate, output: Element) -> Result<Option<f64>> {
    let queries = match candidate {
        Candidate::Lanes(..) => 35,
        Candidate::Units(units, tile) => tile.sides(units)[0] + 3,
    };
    let attended = |kernel: AttentionKernel| -> Result<Vec<f32>> {
        let (mut run, out) = attention(device, kernel, output, queries, 100)?;
        run.execute()?;
        Ok(kernel.element().decode(&run.read::<u8>(out)?))
    };
    let (exact, fast) = (attended(AttentionKernel::Lanes(Element::F32))?, attended(kernel(candidate))?);
    Ok(deviation(LIMIT * output.roundoff(), 0.0, &exact, &fast))
}

fn kernel(candidate: Candidate) -> AttentionKernel {
    match candidate {
        Candidate::Lanes(lanes, _) => AttentionKernel::Lanes(lanes.element),
        Candidate::Units(units, _) => AttentionKernel::Matrix(units),
    }
}

fn attention(
    device: &Device,
    kernel: AttentionKernel,
    factor: Element,
    queries: usize,
    keys: usize,
) -> Result<(Run, Tensor)> {
    let heads = Heads::new(COLUMNS / Tile::TUNED_CHANNELS, COLUMNS);
    let attention = Attention { heads, sequences: 1, queries, common_keys: 0, keys, kernel };
    let tokens = [queries, keys, keys];
    let values = [0, 1, 2].map(|i| encoded_noise(i as u64 + 1, tokens[i], COLUMNS, factor, kernel.element()));
    let mut rec = Recorder::new(device.limits());
    let inputs = [0, 1, 2].map(|i: usize| rec.constant::<u8>("part", values[i].len()));
    let tensors = attention.tensors(&mut rec);
    let of_queries = Part { scale: attention.scale(), ..Part::default() };
    let parts = [of_queries, Part { keys: true, ..Part::default() }, Part::default()];
    for i in 0..3 {
        let projection = Rows { tensor: inputs[i], count: tokens[i], width: COLUMNS, element: kernel.element() };
        attention.split(&mut rec, projection, 0, parts[i], tensors[i]);
    }
    let out = attention.record(&mut rec, tensors).tensor;
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    for (input, values) in inputs.into_iter().zip(&values) {
        run.write(input, values)?;
    }
    Ok((run, out))
}
