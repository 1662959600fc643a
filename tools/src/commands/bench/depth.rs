use super::{
    Repeats, Spread,
    parts::{self, Part},
    peak::{self, Rate},
    python::{self, Pytorch},
    timed_device,
};
use crate::{
    options::{ArithmeticOption, Size},
    released::open_whole_depth,
    session::{Session, Stage},
    table::{Table, bytes},
};
use clap::Args;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    depth::{DepthModel, DepthOptions},
    gpu::{ProfileRow, Run},
    types::Image,
};
use zipsplat_verify::noise::Noise;

/// Time of Depth Anything 3 or VGGT, backbone and heads, by kernel, and its memory
#[derive(Args)]
pub struct Depth {
    /// Weights, as for `depth`
    #[arg(long, value_name = "NAME|PATH|seeded:NAME")]
    weights: String,
    /// Numbers of views
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "4")]
    views: Vec<usize>,
    /// Network input sizes
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "504x336")]
    input_size: Vec<Size>,
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
    network: String,
    views: usize,
    width: u32,
    height: u32,
    #[serde(flatten)]
    part: Part,
    peak_bytes: u64,
    arena_bytes: u64,
}

#[derive(Deserialize)]
struct PytorchRow {
    backbone_ms: Vec<f64>,
    heads_ms: Vec<f64>,
}

impl PytorchRow {
    fn parts(&self) -> impl Iterator<Item = (&'static str, Spread)> {
        PARTS.into_iter().zip([&self.backbone_ms, &self.heads_ms].map(|ms| Spread::of_ms(ms.clone())))
    }
}

const PARTS: [&str; 2] = ["backbone", "heads"];

impl Depth {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let checkpoint = open_whole_depth(&self.weights)?;
        let network = &checkpoint.architecture().name;
        let rays = checkpoint.architecture().multi_view() && checkpoint.architecture().camera_head.is_none();
        if self.pytorch.is_some() && !rays {
            return Err(Error::argument(
                "--pytorch",
                network,
                "a network of Depth Anything 3 that sees all photos at once",
            ));
        }
        self.pytorch.as_deref().map_or(Ok(()), |python| python::DEPTH.check(python))?;
        let device = timed_device(session)?;
        let (precision, arithmetic) = self.arithmetic.choose(session, &device)?;
        let load =
            |stage: &Stage<'_>| DepthModel::from_checkpoint(&device, &checkpoint, arithmetic, |done| stage.at(done));
        let (model, _) = session.stage("load weights", load)?;
        let cases: Vec<(usize, Size)> =
            self.input_size.iter().flat_map(|&size| self.views.iter().map(move |&views| (views, size))).collect();
        let shapes = cases.iter().map(|&(views, Size(width, height))| {
            let all = DepthOptions::default();
            model.network().shape(views, [width, height], all.ratio, &all.token_selection, false, None)
        });
        shapes.collect::<Result<Vec<_>>>()?;
        let measure_peak = |stage: &Stage<'_>| peak::of_products(&device, arithmetic, peak::BRIEFLY, stage);
        let (peak, _) = session.stage("peak", measure_peak)?;

        let (mut rows, mut text) = (Vec::new(), String::new());
        let mut measured = Vec::new();
        for &(views, size) in &cases {
            let name = format!("{views} views of {size}");
            let measure = |stage: &Stage<'_>| self.measure(&model, precision.name(), views, size, &peak, stage);
            let found = match session.stage(&name, measure) {
                // Rows too large for the device keep the earlier ones.
                Err(error @ Error::Memory { .. }) if !rows.is_empty() => {
                    session.note(format!("{name}: {error}"));
                    continue;
                }
                found => found?.0,
            };
            text += &describe(&found, &device.limits().name, &peak);
            measured.push(((views, size), PARTS.map(|part| milliseconds(&found, part))));
            rows.extend(found);
        }
        let compared = self.pytorch.as_ref().map_or(Ok(()), |python| {
            let architecture = serde_json::to_string(checkpoint.architecture()).expect("numbers and names are JSON");
            let words = [architecture].into_iter().chain(self.repeats.words());
            let words = words.chain(measured.iter().map(|((views, size), _)| format!("{views}x{size}")));
            let (found, _) = session.stage("PyTorch", |_| python::DEPTH.run(python, None, words))?;
            text += &compare(&found, &measured);
            rows.extend(pytorch_rows(&found, &rows));
            Ok(())
        });
        // PyTorch may fail.
        session.report(&rows, text)?;
        compared
    }

    fn measure(
        &self,
        model: &DepthModel,
        precision: &'static str,
        views: usize,
        Size(width, height): Size,
        peak: &Rate,
        stage: &Stage<'_>,
    ) -> Result<Vec<Row>> {
        let mut noise = Noise::new(0);
        let images: Vec<Image> = (0..views).map(|_| noise.image(width, height)).collect();
        let request = DepthOptions::default();
        let shape = model.shape(&images, &request)?;
        let (plan, tensors) = model.record(shape, false)?;
        let arena_bytes = plan.arena_bytes();
        let mut run = model.run(plan)?;
        let write = |run: &mut Run| model.write_inputs(run, &tensors, shape, &images, &request);
        let parts = parts::measure(&mut run, write, part_of, self.repeats, peak, stage)?;
        let row = |part: Part| Row {
            precision,
            network: model.architecture().name.clone(),
            views,
            width,
            height,
            part,
            peak_bytes: model.weight_bytes() + arena_bytes,
            arena_bytes,
        };
        Ok(parts.into_iter().map(row).collect())
    }
}

fn part_of(row: &ProfileRow) -> String {
    let mut scopes = row.scope.split('/');
    match (scopes.next(), scopes.next()) {
        (Some("heads"), Some(head)) => format!("heads/{head}"),
        (first, _) => first.unwrap_or_default().to_owned(),
    }
}

fn milliseconds(rows: &[Row], part: &str) -> f64 {
    let stages = rows.iter().map(|row| &row.part).filter(|row| row.kernel.is_empty() && row.stage.starts_with(part));
    stages.map(|row| row.ms.median).sum()
}

fn describe(rows: &[Row], device: &str, peak: &Rate) -> String {
    let Some(total) = rows.first() else { return String::new() };
    let Row { network, views, width, height, precision, .. } = total;
    let [backbone, heads] = PARTS.map(|part| milliseconds(rows, part));
    format!(
        "{network}, {views} views of {width}x{height}, {precision} precision on {device}: {} at most, {} of it the arena; peak: {peak}\n\
         {}backbone {backbone:.0} ms, heads {heads:.0} ms\n\n",
        bytes(total.peak_bytes),
        bytes(total.arena_bytes),
        parts::table(rows.iter().map(|row| &row.part)),
    )
}

fn compare(found: &Pytorch<PytorchRow>, measured: &[((usize, Size), [f64; 2])]) -> String {
    let mut table =
        Table::new(1, &["PyTorch f32", "views", "size", "ms: median (min..max)", "ours", "its time / ours"]);
    for (row, ((views, size), ours)) in found.rows.iter().zip(measured) {
        for ((part, ms), ours) in row.parts().zip(ours) {
            let ratio = format!("{:.2}", ms.median / ours);
            table.row([part.into(), views.to_string(), size.to_string(), ms.to_string(), format!("{ours:.1}"), ratio]);
        }
    }
    format!("{}\n{table}", found.name())
}

fn pytorch_rows(found: &Pytorch<PytorchRow>, rows: &[Row]) -> Vec<Row> {
    let totals = rows.iter().filter(|row| row.part.stage.is_empty());
    let of = |(row, ours): (&PytorchRow, &Row)| {
        let parts = row.parts().map(|(part, ms)| Part { stage: format!("PyTorch f32 {part}"), ms, ..Part::default() });
        parts.map(|part| Row { part, peak_bytes: 0, arena_bytes: 0, ..ours.clone() }).collect::<Vec<_>>()
    };
    found.rows.iter().zip(totals).flat_map(of).collect()
}
