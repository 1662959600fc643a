use super::{
    Repeats, Spread,
    parts::{self, Part},
    peak::{self, Rate},
    python::{self, Pytorch},
    stage_of, timed_device,
};
use crate::{
    options::{ArithmeticOption, Size, Weights, parse_ratio},
    session::{Session, Stage},
    table::{Table, bytes},
};
use clap::Args;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    gpu::Run,
    reconstruct::{KvPool, MAX_VIEWS, Model, Ratio, ReconstructOptions, Shape},
    types::Image,
    weights::Checkpoint,
};
use zipsplat_verify::noise::Noise;

/// Time of the forward pass, by stage and kernel, and its memory
#[derive(Args)]
pub struct Forward {
    #[command(flatten)]
    weights: Weights,
    /// Numbers of views
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "4")]
    views: Vec<usize>,
    /// Fractions of the tokens that become Gaussians, or auto
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1", value_parser = parse_ratio)]
    ratio: Vec<Ratio>,
    /// Keys and values of attention across views
    #[arg(long, alias = "pool", value_name = "LIST", value_delimiter = ',', default_value = "1")]
    kv_pool: Vec<KvPool>,
    /// Network input size [default: the trained size]
    #[arg(long, value_name = "WxH")]
    input_size: Option<Size>,
    #[command(flatten)]
    arithmetic: ArithmeticOption,
    #[command(flatten)]
    repeats: Repeats,
    /// Also time PyTorch with this Python, on its GPU or CPU
    #[arg(long, value_name = "PYTHON")]
    pytorch: Option<PathBuf>,
}

#[derive(Clone, Serialize)]
struct Row {
    precision: &'static str,
    views: usize,
    tokens: usize,
    ratio: f64,
    pool: String,
    #[serde(flatten)]
    part: Part,
    peak_bytes: u64,
    arena_bytes: u64,
}

#[derive(Deserialize)]
struct PytorchRow {
    precision: String,
    views: usize,
    ratio: f64,
    ms: Option<Vec<f64>>,
    peak_bytes: Option<u64>,
    failed: Option<String>,
}

impl Forward {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let checkpoint = self.weights.open()?;
        let size = Size::or_best(self.input_size, &checkpoint);
        let Size(width, height) = size;
        let mut requests = Vec::new();
        for &views in &self.views {
            for &ratio in &self.ratio {
                for &pool in &self.kv_pool {
                    let request = ReconstructOptions { ratio, kv_pool: pool, ..ReconstructOptions::default() };
                    let (architecture, selection) = (checkpoint.architecture(), &request.token_selection);
                    Shape::new(architecture, views, [width, height], ratio, selection, false)?;
                    requests.push((views, request));
                }
            }
        }
        self.pytorch.as_deref().map_or(Ok(()), |python| python::FORWARD.check(python))?;
        let device = timed_device(session)?;
        let (precision, arithmetic) = self.arithmetic.choose(session, &device)?;
        let (model, _) = session.load_model(&device, &checkpoint, arithmetic)?;
        let measure_peak = |stage: &Stage<'_>| peak::of_products(&device, arithmetic, peak::BRIEFLY, stage);
        let (peak, _) = session.stage("peak", measure_peak)?;
        let most = self.views.iter().copied().max().unwrap_or(0).min(MAX_VIEWS);
        let mut noise = Noise::new(0);
        let images: Vec<Image> = (0..most).map(|_| noise.image(width, height)).collect();

        let (mut rows, mut text) = (Vec::new(), String::new());
        for (views, request) in &requests {
            let name = format!("{views} views");
            let images = &images[..*views];
            let measured =
                session.stage(&name, |stage| self.measure(&model, precision.name(), images, request, &peak, stage));
            let measured = match measured {
                Err(error @ Error::Memory { .. }) if !rows.is_empty() => {
                    session.note(format!("{name}: {error}"));
                    continue;
                }
                measured => measured?.0,
            };
            text += &describe(&measured, &device.limits().name, &peak);
            rows.extend(measured);
        }
        let compared = self.pytorch.as_ref().map_or(Ok(()), |python| {
            // PyTorch has no pooling.
            let is_like = |row: &&Row| row.part.stage.is_empty() && row.pool == "1";
            let totals: Vec<Row> = rows.iter().filter(is_like).cloned().collect();
            let ((table, more), _) = session.stage("PyTorch", |_| self.compare(python, &checkpoint, size, &totals))?;
            text += &table;
            rows.extend(more);
            Ok(())
        });
        // PyTorch may fail.
        session.report(&rows, text)?;
        compared
    }

    fn compare(
        &self,
        python: &Path,
        checkpoint: &Checkpoint,
        size: Size,
        totals: &[Row],
    ) -> Result<(String, Vec<Row>)> {
        let architecture = serde_json::to_string(checkpoint.architecture()).expect("numbers and names are JSON");
        let words = [architecture].into_iter().chain(self.repeats.words()).chain([size.to_string()]);
        let words = words.chain(totals.iter().map(|row| format!("{}:{}", row.views, row.ratio)));
        let mut found: Pytorch<PytorchRow> = python::FORWARD.run(python, None, words)?;
        let mut table =
            Table::new(1, &["PyTorch", "views", "ratio", "ms: median (min..max)", "peak", "its time / ours"]);
        let mut rows = Vec::new();
        for (pytorch, ours) in std::mem::take(&mut found.rows).into_iter().zip(totals.iter().cycle()) {
            let ms = pytorch.ms.map(Spread::of_ms);
            table.row([
                pytorch.precision.clone(),
                pytorch.views.to_string(),
                format!("{:.3}", pytorch.ratio),
                ms.map_or_else(|| pytorch.failed.clone().unwrap_or_default(), |ms| ms.to_string()),
                pytorch.peak_bytes.map_or_else(String::new, bytes),
                ms.map_or_else(String::new, |ms| format!("{:.2}", ms.median / ours.part.ms.median)),
            ]);
            let Some(ms) = ms else { continue };
            rows.push(Row {
                part: Part {
                    gflop: ours.part.gflop,
                    gflop_per_s: ms.rate((1e9 * ours.part.gflop) as u64),
                    stage: format!("PyTorch {}", pytorch.precision),
                    ms,
                    ..Part::default()
                },
                peak_bytes: pytorch.peak_bytes.unwrap_or(0),
                arena_bytes: 0,
                ..ours.clone()
            });
        }
        Ok((format!("{}\n{table}", found.name()), rows))
    }

    fn measure(
        &self,
        model: &Model,
        precision: &'static str,
        images: &[Image],
        request: &ReconstructOptions,
        peak: &Rate,
        stage: &Stage<'_>,
    ) -> Result<Vec<Row>> {
        let shape = model.shape(images, request)?;
        let (plan, tensors) = model.record(shape, false)?;
        let arena_bytes = plan.arena_bytes();
        let peak_bytes = model.weight_bytes() + model.plan(shape)?.bytes();
        let mut run = model.run(plan)?;
        let write = |run: &mut Run| model.write_inputs(run, &tensors, shape, images, request);
        let parts = parts::measure(&mut run, write, stage_of, self.repeats, peak, stage)?;
        let row = |part: Part| Row {
            precision,
            views: images.len(),
            tokens: shape.tokens,
            ratio: shape.tokens as f64 / shape.grid.tokens() as f64,
            pool: shape.kv_pool.to_string(),
            part,
            peak_bytes,
            arena_bytes,
        };
        Ok(parts.into_iter().map(row).collect())
    }
}

fn describe(rows: &[Row], device: &str, peak: &Rate) -> String {
    let Some(total) = rows.first() else { return String::new() };
    let pooled = if total.pool == "1" { String::new() } else { format!(" --kv-pool {},", total.pool) };
    let table = parts::table(rows.iter().map(|row| &row.part));
    format!(
        "{} views, {} tokens,{pooled} {} precision on {device}: {} at most, {} of it the arena; peak: {peak}\n{table}\n",
        total.views,
        total.tokens,
        total.precision,
        bytes(total.peak_bytes),
        bytes(total.arena_bytes)
    )
}
