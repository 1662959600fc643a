//! `zipsplat bench gemm`: the linear layer's kernel beside a matrix product on the host.

use super::{
    Repeats, Spread,
    peak::{self, Rate},
    percent, timed_device,
};
use crate::{
    noise::Noise,
    session::{Session, Stage},
    table::Table,
};
use clap::Args;
use gemm::Parallelism;
use serde::Serialize;
use std::time::{Duration, Instant};
use zipsplat::{
    Result,
    gpu::{Device, Element, Recorder, Run},
    ops::{Epilogue, LaneTile, Lanes, Linear, LinearKernel, Rows, Tiles, Units, Weights, pack_matrix},
};

/// Rows, inner dimension and columns: ViT-S with 4 views, then ViT-G of one view, up and down.
const SHAPES: [[usize; 3]; 3] = [[1296, 384, 1536], [324, 1536, 6144], [1300, 1536, 384]];

/// Time of linear layers, exact (also with weights of 8 bits) and fast, by every tile of lanes, beside that of the `gemm` crate on the
/// host in f32
#[derive(Args)]
pub struct Gemm {
    /// Threads of the host
    #[arg(long, value_name = "N", default_value = "2", value_parser = clap::value_parser!(u16).range(1..))]
    threads: u16,
    #[command(flatten)]
    repeats: Repeats,
}

#[derive(Serialize)]
struct Row {
    /// `exact`, `exact q8` with weights of 8 bits, or what computes it in `fast`, and the tile where it is in shared memory.
    kernel: String,
    rows: usize,
    inner: usize,
    columns: usize,
    device_ms: Spread,
    device_gflop_per_s: f64,
    /// The share of the measured rate of what multiplies: lanes, or matrix units.
    peak_share: Option<f64>,
    host_ms: Spread,
    host_gflop_per_s: f64,
    /// Rate of the device over that of the host.
    ratio: f64,
    /// Largest difference of the two products over the largest value.
    difference: f32,
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
        let host_column = format!("gemm, {} threads: ms", self.threads);
        let mut table = Table::new(
            2,
            &["shape", "kernel", &device_column, "GFLOP/s", "of peak", &host_column, "GFLOP/s", "ratio", "difference"],
        );
        for row in &rows {
            table.row([
                format!("{}x{}x{}", row.rows, row.inner, row.columns),
                row.kernel.clone(),
                row.device_ms.to_string(),
                format!("{:.1}", row.device_gflop_per_s),
                percent(row.peak_share),
                row.host_ms.to_string(),
                format!("{:.1}", row.host_gflop_per_s),
                format!("{:.2}", row.ratio),
                format!("{:.0e}", row.difference),
            ]);
        }
        session.report(&rows, table)
    }

    /// Every kernel that the device has.
    fn measure(
        &self,
        device: &Device,
        kernels: &[(String, LinearKernel, Rate)],
        shape: [usize; 3],
        stage: &Stage<'_>,
    ) -> Result<Vec<Row>> {
        let [rows, inner, columns] = shape;
        let mut noise = Noise(0);
        let (a, b) = (noise.values(rows * inner), noise.values(inner * columns));
        let Repeats { warmup, repeats } = self.repeats;
        let mut on_host = vec![0.0; rows * columns];
        let mut host_times = Vec::new();
        for i in 0..warmup + repeats {
            stage.reach(0.5 * f64::from(i) / f64::from(warmup + repeats))?;
            let start = Instant::now();
            multiply(shape, &a, &b, &mut on_host, self.threads.into());
            host_times.push(start.elapsed());
        }
        let host_ms = Spread::of(host_times.split_off(warmup as usize));
        let largest = on_host.iter().fold(0f32, |most, value| most.max(value.abs()));
        let flops = 2 * (rows * inner * columns) as u64;
        let measure = |(name, kernel, peak): &(String, LinearKernel, Rate)| {
            let (times, on_device) = on_device(device, shape, *kernel, (&a, &b), self.repeats, stage)?;
            let apart = on_host.iter().zip(&on_device).map(|(x, y)| (x - y).abs()).fold(0f32, larger_or_nan);
            let device_ms = Spread::of(times);
            let (device_gflop_per_s, host_gflop_per_s) = (device_ms.rate(flops), host_ms.rate(flops));
            Ok(Row {
                kernel: name.clone(),
                rows,
                inner,
                columns,
                device_ms,
                device_gflop_per_s,
                peak_share: peak.share(device_gflop_per_s),
                host_ms,
                host_gflop_per_s,
                ratio: device_gflop_per_s / host_gflop_per_s,
                difference: apart / largest,
            })
        };
        kernels.iter().map(measure).collect()
    }
}

/// As `f32::max`, which would hide a NaN.
fn larger_or_nan(most: f32, value: f32) -> f32 {
    if value > most || value.is_nan() { value } else { most }
}

/// The kernels of linear layers that a device has, with the limit of each.
fn kernels(device: &Device, stage: &Stage<'_>) -> Result<Vec<(String, LinearKernel, Rate)>> {
    let limits = device.limits();
    let lanes = peak::fma(device, peak::BRIEFLY, stage)?;
    let mut kernels = Vec::new();
    let mut on_lanes = |name: String, tiled: Lanes, weights: Weights| {
        kernels.push((name, LinearKernel::Panels(tiled, weights), lanes.clone()));
    };
    on_lanes("exact q8".into(), Lanes::of(Element::F32), Weights::Q8);
    for element in [Element::F32].into_iter().chain(Element::HALVES.into_iter().filter(|_| limits.half_storage)) {
        let name = if element == Element::F32 { "exact" } else { element.name() };
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

/// Device times and the product `[rows, columns]`.
fn on_device(
    device: &Device,
    [rows, inner, columns]: [usize; 3],
    kernel: LinearKernel,
    (a, b): (&[f32], &[f32]),
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
        stage.reach(0.5 + 0.5 * f64::from(i) / f64::from(warmup + repeats))?;
        let (time, _) = run.profile()?.total("");
        if i >= warmup {
            times.push(time);
        }
    }
    Ok((times, run.read(out)?))
}

/// `out` `[rows, columns]` = `a` `[rows, inner]` * `b` `[columns, inner]` transposed.
#[rustfmt::skip]
fn multiply([rows, inner, columns]: [usize; 3], a: &[f32], b: &[f32], out: &mut [f32], threads: usize) {
    assert_eq!((a.len(), b.len(), out.len()), (rows * inner, inner * columns, rows * columns));
    let (out_stride, stride) = (columns as isize, inner as isize);
    let (out, a, b) = (out.as_mut_ptr(), a.as_ptr(), b.as_ptr());
    let threads = Parallelism::Rayon(threads);
    // SAFETY: strides, a column's before a row's, are those of matrices of the lengths asserted; `out` overlaps neither.
    #[allow(unsafe_code)]
    unsafe {
        gemm::gemm(
            rows, columns, inner, out, 1, out_stride, false, a, 1, stride, b, stride, 1, 0.0, 1.0, false, false, false,
            threads,
        );
    }
}
