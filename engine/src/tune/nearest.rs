use super::{COLUMNS, Candidate, Operation, TERMS, kernel_name, noise::noise, self_test::deviation};
use crate::{
    Result,
    gpu::{Device, Element, Recorder, Run, Tensor},
    ops::{Nearest, NearestKernel, Rows, Tile},
};

/// Relative squared distance: rounding plus ties.
const LIMIT: f64 = 1e-5 + Nearest::TIE as f64;

pub(super) const NEAREST: Operation = Operation {
    name: "nearest",
    // f32 differences are always exact.
    lanes: &[],
    factors: &[Element::F16],
    tiles: Tile::nearest,
    lane_tiles: |_, _| Vec::new(),
    kernels: |on_units, factor| vec![(kernel_name("cluster/nearest", on_units, factor), Element::F32)],
    deviation: nearest_deviation,
    timed,
    chosen: |arithmetic| vec![&mut arithmetic.nearest],
    chosen_on_lanes: |_| Vec::new(),
};

/// The low halves must separate near ties.
fn nearest_deviation(device: &Device, candidate: Candidate, _: Element) -> Result<Option<f64>> {
    const WIDTH: usize = 76;
    let Candidate::Units(units, tile) = candidate else { return Ok(Some(0.0)) };
    // Several workgroups per axis, the last partial.
    let [points, targets] = tile.sides(units);
    let (points, targets) = (4 * points + 3, 2 * targets + 6);
    let [mut from, to] = [(1, points), (2, targets)].map(|(seed, rows)| noise(seed, rows, WIDTH, Element::F32));
    for (i, x) in from.iter_mut().enumerate() {
        let at = i / WIDTH % (targets - 1) * WIDTH + i % WIDTH;
        *x = 0.5 * (to[at] + to[at + WIDTH]) + *x / 2048.0;
    }
    let distances = |kernel: NearestKernel| -> Result<Vec<f32>> {
        let (mut run, out) = nearest(device, kernel, [&from, &to], WIDTH)?;
        run.execute()?;
        let squared = |(point, index): (&[f32], u32)| {
            let target = to.chunks(WIDTH).nth(index as usize).unwrap_or(&[f32::NAN; WIDTH]);
            let squares = point.iter().zip(target).map(|(p, t)| f64::from(p - t).powi(2));
            squares.sum::<f64>() as f32
        };
        Ok(from.chunks(WIDTH).zip(run.read(out)?).map(squared).collect())
    };
    let (exact, fast) = (distances(NearestKernel::Lanes)?, distances(NearestKernel::Matrix(units))?);
    Ok(deviation(LIMIT, 0.0, &exact, &fast))
}

fn timed(device: &Device, candidate: Candidate, rows: usize) -> Result<Run> {
    let kernel = match candidate {
        Candidate::Lanes(..) => NearestKernel::Lanes,
        Candidate::Units(units, _) => NearestKernel::Matrix(units),
    };
    let [points, targets] = [(1, rows), (2, COLUMNS)].map(|(seed, rows)| noise(seed, rows, TERMS, Element::F32));
    nearest(device, kernel, [&points, &targets], TERMS).map(|(run, _)| run)
}

fn nearest(device: &Device, kernel: NearestKernel, rows: [&[f32]; 2], width: usize) -> Result<(Run, Tensor)> {
    let mut rec = Recorder::new(device.limits());
    let inputs = rows.map(|rows| Rows::new(rec.constant::<f32>("rows", rows.len()), rows.len() / width, width));
    let nearest = Nearest::among(&mut rec, kernel, inputs[1]);
    let [points, targets] = inputs.map(|rows| nearest.rows(&mut rec, rows));
    let out = nearest.record(&mut rec, points, targets);
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    for (input, rows) in inputs.into_iter().zip(rows) {
        run.write(input.tensor, rows)?;
    }
    Ok((run, out))
}
