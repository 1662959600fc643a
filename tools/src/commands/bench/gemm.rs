use super::{
    Repeats, Spread,
    peak::{self, Rate},
    percent, timed_device,
};
use crate::{
    session::{Session, Stage},
    table::Table,
};
use clap::Args;
use serde::Serialize;
use std::time::Duration;
use zipsplat::{
    Result,
    gpu::{Device, Element, Recorder, Run},
    ops::{Epilogue, LaneTile, Lanes, Linear, LinearKernel, Rows, Tiles, Units, Weights, pack_matrix},
};
use zipsplat_reference::{ops::linear::linear, widen};
use zipsplat_verify::noise::Noise;

/// Rows, inner dimension, columns: ViT-S with 4 views; ViT-G with one, up and down.
const SHAPES: [[usize; 3]; 3] = [[1296, 384, 1536], [324, 1536, 6144], [1300, 1536, 384]];

const CHECKED_ROWS: usize = 16;

/// Time of linear layers in fp32 (also with 8-bit weights) and fp16, by tile
#[derive(Args)]
pub struct Gemm {
    #[command(flatten)]
    repeats: Repeats,
}

#[derive(Serialize)]
struct Row {
    /// `fp32`, `fp32 q8`, or the matrix unit of `fp16`, and any shared-memory tile.
    kernel: String,
    rows: usize,
    inner: usize,
    columns: usize,
    device_ms: Spread,
    device_gflop_per_s: f64,
    peak_share: Option<f64>,
    /// Relative to the largest value.
    difference: f64,
}

impl Gemm {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let device = timed_device(session)?;
        let (kernels, _) = session.stage("peak", |stage| kernels(&device, stage))?;
        let mut rows = Vec::new();
        for shape in SHAPES {
            let name = shape.map(|side| side.to_string()).join("x");
            rows.extend(session.stage(&name, |stage| self.measure(&device, &kernels, shape, stage))?.0);
        }
        let device_column = format!("{}: ms", device.limits().name);
        let mut table = Table::new(2, &["shape", "kernel", &device_column, "GFLOP/s", "of peak", "difference"]);
        for row in &rows {
            table.row([
                format!("{}x{}x{}", row.rows, row.inner, row.columns),
                row.kernel.clone(),
                row.device_ms.to_string(),
                format!("{:.1}", row.device_gflop_per_s),
                percent(row.peak_share),
                format!("{:.0e}", row.difference),
            ]);
        }
        session.report(&rows, table)
    }

    fn measure(
        &self,
        device: &Device,
        kernels: &[(String, LinearKernel, Rate)],
        shape: [usize; 3],
        stage: &Stage<'_>,
    ) -> Result<Vec<Row>> {
        let [rows, inner, columns] = shape;
        let mut noise = Noise::new(0);
        let (a, b) = (noise.values(rows * inner), noise.values(inner * columns));
        let (stride, bias) = (rows / CHECKED_ROWS, vec![0.0; columns]);
        let checked: Vec<f32> = a.chunks(inner).step_by(stride).flatten().copied().collect();
        let expected = linear(&widen(&checked), &b, &bias);
        let largest = expected.iter().fold(0f64, |most, value| most.max(value.abs()));
        let flops = 2 * (rows * inner * columns) as u64;
        let measure = |(name, kernel, peak): &(String, LinearKernel, Rate)| {
            let (times, product) = on_device(device, shape, *kernel, &a, &b, self.repeats, stage)?;
            let computed = product.chunks(columns).step_by(stride).flatten();
            let apart = expected.iter().zip(computed).map(|(x, &y)| (x - f64::from(y)).abs());
            let device_ms = Spread::of(times);
            let device_gflop_per_s = device_ms.rate(flops);
            Ok(Row {
                kernel: name.clone(),
                rows,
                inner,
                columns,
                device_ms,
                device_gflop_per_s,
                peak_share: peak.share(device_gflop_per_s),
                difference: apart.fold(0.0, larger_or_nan) / largest,
            })
        };
        kernels.iter().map(measure).collect()
    }
}

fn larger_or_nan(most: f64, value: f64) -> f64 {
    if value > most || value.is_nan() { value } else { most }
}

fn kernels(device: &Device, stage: &Stage<'_>) -> Result<Vec<(String, LinearKernel, Rate)>> {
    let limits = device.limits();
    let lanes = peak::fma(device, peak::BRIEFLY, stage)?;
    let mut kernels = Vec::new();
    let mut on_lanes = |name: String, tiled: Lanes, weights: Weights| {
        kernels.push((name, LinearKernel::Panels(tiled, weights), lanes.clone()));
    };
    on_lanes("fp32 q8".into(), Lanes::of(Element::F32), Weights::Q8);
    for element in [Element::F32].into_iter().chain(Element::HALVES.into_iter().filter(|_| limits.half_storage)) {
        let name = if element == Element::F32 { "fp32" } else { element.name() };
        on_lanes(name.into(), Lanes::of(element), Weights::Factors);
        for (index, tile) in LaneTile::candidates(limits, element).iter().enumerate().skip(1) {
            on_lanes(format!("{name}, {tile}"), Lanes { element, tiles: Tiles::always(index) }, Weights::Factors);
        }
    }
    let tiles = if limits.dot_products { LaneTile::candidates(limits, Element::I8) } else { Vec::new() };
    for (index, tile) in tiles.iter().enumerate() {
        kernels.push((format!("i8, {tile}"), LinearKernel::Dots(Tiles::always(index)), lanes.clone()));
    }
    for units in Element::FACTORS.into_iter().filter_map(|factor| Units::of(factor, limits)) {
        let peak = peak::matrices(device, units, peak::BRIEFLY, stage)?;
        kernels.push((
            format!("{} matrices", units.factor.name()),
            LinearKernel::Matrix(units, Weights::Factors),
            peak,
        ));
    }
    Ok(kernels)
}

fn on_device(
    device: &Device,
    [rows, inner, columns]: [usize; 3],
    kernel: LinearKernel,
    a: &[f32],
    b: &[f32],
    Repeats { warmup, repeats }: Repeats,
    stage: &Stage<'_>,
) -> Result<(Vec<Duration>, Vec<f32>)> {
    let mut rec = Recorder::new(device.limits());
    let (packed_input, packed) = (kernel.element().encode(a), pack_matrix(kernel, b, inner, columns));
    let input = rec.constant::<u8>("input", packed_input.len());
    let weight = rec.constant::<u8>("weight", packed.len());
    let bias = rec.constant::<f32>("bias", columns);
    let layer = Linear { weight, bias, inner, columns, kernel };
    let a_rows = Rows { tensor: input, count: rows, width: inner, element: kernel.element() };
    let out = layer.apply(&mut rec, "out", a_rows, Element::F32, Epilogue::default()).tensor;
    rec.output(out);
    let mut run = Run::new(device, rec.finish()?)?;
    run.write(input, &packed_input)?;
    run.write(weight, &packed)?;
    run.write(bias, &vec![0f32; columns])?;
    let mut times = Vec::new();
    for i in 0..warmup + repeats {
        stage.reach(f64::from(i) / f64::from(warmup + repeats))?;
        let (time, _) = run.profile()?.total("");
        if i >= warmup {
            times.push(time);
        }
    }
    Ok((times, run.read(out)?))
}
