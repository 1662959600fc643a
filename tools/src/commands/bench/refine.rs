use super::{
    Group, MOST_GAUSSIANS, Repeats, Spread, group, pass,
    peak::{self, Rate},
    percent,
    python::{self, Pytorch},
    timed_device,
};
use crate::{
    options::Size,
    session::{Session, Stage},
    table::{Table, bytes},
};
use clap::Args;
use serde::{Deserialize, Serialize};
use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    gpu::{Arena, Device},
    refine::{RefineLength, RefineOptions as Request, RefineResult, StopReason, refine_scene},
    stages::render::{RenderOptions, Renderer},
    types::{Camera, Image, Scene},
};
use zipsplat_verify::noise::{self, Noise};

/// Progress checks, excluded from times.
const LOOKS: usize = 20;
const PYTORCH_DEGREE: u32 = 1;

/// Time of a refinement step, by pass, and of a render of the same cameras
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat bench refine
  zipsplat bench refine --gaussians 36000,102000,249000 --size 252x252 --photos 4
  zipsplat bench refine --pytorch python3

Each case has a row per pass, and three totals: step, the sum of the passes; picture, the
device's time of the same cameras' renders alone; host, a step measured on the host.
Shares are relative to a copy and to multiply-adds in the same run. They count every
tensor of a pass once, and the arithmetic of all pixels in the tiles of each Gaussian.")]
pub struct Refine {
    /// Numbers of Gaussians
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "36000,102000",
        value_parser = clap::value_parser!(u32).range(1..=MOST_GAUSSIANS))]
    gaussians: Vec<u32>,
    /// Sizes of the photos
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "252x252")]
    size: Vec<Size>,
    /// Degree of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "DEGREE", default_value = "1",
        value_parser = clap::value_parser!(u32).range(0..=i64::from(Scene::MAX_SH_DEGREE)))]
    sh: u32,
    /// Photos per step, in one batch
    #[arg(long, value_name = "N", default_value = "1", value_parser = clap::value_parser!(u32).range(1..=64))]
    photos: u32,
    /// Also time PyTorch with this Python, which needs torch, numpy and numba
    #[arg(long, value_name = "PYTHON")]
    pytorch: Option<PathBuf>,
    #[command(flatten)]
    repeats: Repeats,
}

#[derive(Default, Serialize)]
struct Row {
    gaussians: usize,
    width: u32,
    height: u32,
    sh_degree: u32,
    photos: usize,
    /// Pass; `step` for all, `picture` for rendering, `host` for host time.
    what: String,
    commands: u32,
    ms: Spread,
    pictures: Option<f64>,
    bandwidth_share: Option<f64>,
    fma_share: Option<f64>,
    peak_bytes: u64,
}

#[derive(Deserialize)]
struct PytorchRow {
    what: String,
    ms: Vec<f64>,
}

struct Case {
    scene: Scene,
    size: Size,
    photos: Vec<Image>,
    cameras: Vec<Camera>,
}

struct Limits {
    copy: Rate,
    fma: Rate,
}

impl Refine {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        if self.pytorch.is_some() && self.sh > PYTORCH_DEGREE {
            return Err(Error::argument("--sh", self.sh, "0 or 1 with --pytorch"));
        }
        self.pytorch.as_deref().map_or(Ok(()), |python| python::REFINE.check(python))?;
        let device = timed_device(session)?;
        let copy = session.stage("copies", |stage| peak::copies(&device, peak::BRIEFLY, stage))?.0;
        let fma = session.stage("FMA", |stage| peak::fma(&device, peak::BRIEFLY, stage))?.0;
        let limits = Limits { copy, fma };
        let mut rows = Vec::new();
        for &gaussians in &self.gaussians {
            for &size in &self.size {
                let case = Case::new(gaussians as usize, self.sh, size, self.photos as usize);
                let name = format!("{gaussians} at {size}");
                rows.extend(session.stage(&name, |stage| self.measure(&device, &case, &limits, stage))?.0);
                if let Some(python) = &self.pytorch {
                    let pytorch_rows = session.stage("PyTorch", |_| self.pytorch_rows(python, &case))?.0;
                    rows.extend(pytorch_rows);
                }
            }
        }
        let text = format!("{}, {}, {}\n{}", device.limits().name, limits.copy, limits.fma, table(&rows));
        session.report(&rows, text)
    }

    fn measure(&self, device: &Device, case: &Case, limits: &Limits, stage: &Stage<'_>) -> Result<Vec<Row>> {
        let Repeats { warmup, repeats } = self.repeats;
        let runs = warmup + repeats;
        // Exact capacity: bytes and arithmetic are those in use.
        let intersection_capacity = case.intersections(device)?;
        let (mut profiles, mut peak_bytes) = (Vec::new(), 0);
        for i in 0..runs {
            stage.reach(0.5 * f64::from(i) / f64::from(runs))?;
            let found = case.refine(device, intersection_capacity, 0, |_| ControlFlow::Continue(()))?;
            peak_bytes = found.peak_bytes;
            profiles.extend(found.profile.filter(|_| i >= warmup));
        }
        let host = self.host(device, case, intersection_capacity, stage)?;
        let mut renderer = Renderer::new(device);
        renderer.set_scene(&case.scene)?;
        let mut pictures = Vec::new();
        for i in 0..runs {
            stage.check()?;
            let mut took = Duration::ZERO;
            for camera in &case.cameras {
                took += renderer.profile(camera, &RenderOptions::default())?.total("").0;
            }
            pictures.extend((i >= warmup).then_some(took));
        }
        let pictures = Spread::of(pictures);
        let row = |Group { name, count, flops, bytes, ms }: Group| Row {
            what: name,
            commands: count,
            pictures: Some(ms.median / pictures.median.max(1e-6)),
            bandwidth_share: limits.copy.share(ms.rate(bytes)),
            fma_share: limits.fma.share(ms.rate(flops)),
            ms,
            peak_bytes,
            ..case.row()
        };
        let mut groups = group(&profiles, pass);
        groups.extend(group(&profiles, |_| "step".into()));
        groups.extend([Group::of("picture", pictures), Group::of("host", host)]);
        Ok(groups.into_iter().map(row).collect())
    }

    fn host(&self, device: &Device, case: &Case, intersection_capacity: usize, stage: &Stage<'_>) -> Result<Spread> {
        let (warmup, counted) = (self.repeats.warmup as usize, self.repeats.repeats as usize);
        let steps = (2 * (warmup + counted)).max(3 * LOOKS);
        let (interval, mut times, mut last) = (steps.div_ceil(LOOKS), Vec::new(), Instant::now());
        let refined = case.refine(device, intersection_capacity, steps, |step| {
            if step > warmup && !step.is_multiple_of(interval) && step < steps {
                times.push(last.elapsed());
            }
            last = Instant::now();
            if times.len() < counted {
                stage.at(0.5 + 0.5 * times.len() as f64 / counted as f64)
            } else {
                ControlFlow::Break(())
            }
        })?;
        stage.check()?;
        match refined.stop_reason {
            Some(StopReason::Diverged(_)) if times.is_empty() => {
                Err(Error::argument("photos of noise", "a loss that grew", "fewer --warmup"))
            }
            _ => Ok(Spread::of(times)),
        }
    }

    fn pytorch_rows(&self, python: &Path, case: &Case) -> Result<Vec<Row>> {
        let numbers = [case.size.0, case.size.1, case.photos.len() as u32].map(|number| number.to_string());
        let words = numbers.into_iter().chain(self.repeats.words());
        let mut found: Pytorch<PytorchRow> = python::REFINE.run(python, Some(&case.scene), words)?;
        let rows = std::mem::take(&mut found.rows).into_iter().map(|row| (row.what, Spread::of_ms(row.ms)));
        let rows: Vec<_> = rows.collect();
        let picture = rows.iter().find(|(what, _)| what == "picture").map_or(f64::NAN, |(_, ms)| ms.median);
        let row = |(what, ms): (String, Spread)| Row {
            what: format!("{}: {what}", found.name()),
            ms,
            pictures: Some(ms.median / picture.max(1e-6)),
            ..case.row()
        };
        Ok(rows.into_iter().map(row).collect())
    }
}

impl Case {
    fn new(gaussians: usize, sh_degree: u32, size: Size, photos: usize) -> Self {
        let mut noise = Noise::new(2);
        let camera = |i: usize| {
            let mut camera = noise::camera(size.0, size.1);
            camera.pose.translation.x = 0.01 * i as f64;
            camera
        };
        Self {
            scene: Noise::new(1).scene(gaussians, sh_degree),
            size,
            photos: (0..photos).map(|_| noise.image(size.0, size.1)).collect(),
            cameras: (0..photos).map(camera).collect(),
        }
    }

    fn intersections(&self, device: &Device) -> Result<usize> {
        let mut renderer = Renderer::new(device);
        renderer.set_scene(&self.scene)?;
        let count = |camera: &Camera| {
            renderer.render(&[*camera], &RenderOptions::default())?;
            Ok(renderer.intersections())
        };
        Ok(self.cameras.iter().map(count).collect::<Result<Vec<_>>>()?.into_iter().max().unwrap_or(0))
    }

    fn refine(
        &self,
        device: &Device,
        intersection_capacity: usize,
        steps: usize,
        mut progress: impl FnMut(usize) -> ControlFlow<()>,
    ) -> Result<RefineResult> {
        let count = self.photos.len();
        let request = Request {
            length: RefineLength::Steps(steps),
            views_per_step: count,
            batch_size: Some(count),
            holdout_views: Some(0),
            coarse_to_fine: false,
            intersection_capacity: Some(intersection_capacity),
            profile: steps == 0,
            ..Request::default()
        };
        refine_scene(&Arena::new(device), &self.scene, &self.photos, &self.cameras, &request, |now| progress(now.step))
    }

    fn row(&self) -> Row {
        Row {
            gaussians: self.scene.len(),
            width: self.size.0,
            height: self.size.1,
            sh_degree: self.scene.sh_degree,
            photos: self.photos.len(),
            ..Row::default()
        }
    }
}

fn table(rows: &[Row]) -> Table {
    let headings = [
        "pass",
        "Gaussians",
        "size",
        "photos",
        "commands",
        "ms: median (min..max)",
        "pictures",
        "of bandwidth",
        "of FMA",
        "peak",
    ];
    let mut table = Table::new(1, &headings);
    for row in rows {
        table.row([
            row.what.clone(),
            row.gaussians.to_string(),
            Size(row.width, row.height).to_string(),
            row.photos.to_string(),
            row.commands.to_string(),
            row.ms.to_string(),
            row.pictures.map_or_else(String::new, |over| format!("{over:.2}")),
            percent(row.bandwidth_share),
            percent(row.fma_share),
            if row.what == "step" { bytes(row.peak_bytes) } else { String::new() },
        ]);
    }
    table
}
