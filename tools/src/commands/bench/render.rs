use super::{
    Group, MOST_GAUSSIANS, Repeats, Spread, effects, group, pass,
    peak::{self, Rate},
    percent, python, timed_device,
};
use crate::{
    options::Size,
    session::{Session, Stage},
    table::Table,
};
use clap::Args;
use serde::Serialize;
use std::{
    path::PathBuf,
    time::{Duration, Instant},
};
use zipsplat::{
    Result,
    gpu::Device,
    stages::render::{RenderOptions, Renderer},
    types::Scene,
};
use zipsplat_verify::noise::{self, Noise};

/// Busy time until a GPU's highest clock.
const FULL_CLOCK: Duration = Duration::from_millis(200);

/// Time of a render, by pass
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat bench render
  zipsplat bench render --gaussians 36000,102000,500000,2000000,6000000 --size 252x252,1920x1080,3840x2160 --sh 0,1,3
  zipsplat bench render --effects
  zipsplat bench render --gsplat python3

Each case has a row per pass, and three totals: device, the sum of the passes; host, one
picture with its readback; in flight, a picture among overlapping submissions. The share
of bandwidth counts every tensor of a pass once, relative to a copy in the same run.")]
pub struct Render {
    /// Numbers of Gaussians
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "36000,102000",
        value_parser = clap::value_parser!(u32).range(1..=MOST_GAUSSIANS))]
    gaussians: Vec<u32>,
    /// Sizes of the pictures
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "252x252")]
    size: Vec<Size>,
    /// Degrees of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1",
        value_parser = clap::value_parser!(u32).range(0..=i64::from(Scene::MAX_SH_DEGREE)))]
    sh: Vec<u32>,
    /// Measure each effect off and on instead, with the first value of each list
    #[arg(long, conflicts_with = "gsplat")]
    effects: bool,
    /// Also time gsplat with this Python, PyTorch and a CUDA GPU
    #[arg(long, value_name = "PYTHON")]
    gsplat: Option<PathBuf>,
    #[command(flatten)]
    repeats: Repeats,
}

#[derive(Serialize)]
struct Row {
    gaussians: usize,
    width: u32,
    height: u32,
    sh_degree: u32,
    intersections: usize,
    /// Pass; `device` for all, `host` for a frame in host memory, `in flight` for pipelined frames,
    /// `gsplat`.
    what: String,
    commands: u32,
    ms: Spread,
    frames_per_s: f64,
    bytes: Option<u64>,
    bandwidth_share: Option<f64>,
}

impl Render {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let device = timed_device(session)?;
        if self.effects {
            let (gaussians, size, sh) = (self.gaussians[0], self.size[0], self.sh[0].max(1));
            let scene = Noise::new(1).scene(gaussians as usize, sh);
            return effects::run(session, &device, &scene, size, &self.repeats);
        }
        self.gsplat.as_deref().map_or(Ok(()), |python| python::GSPLAT.check(python))?;
        let bandwidth = session.stage("copies", |stage| peak::copies(&device, peak::BRIEFLY, stage))?.0;
        let mut rows = Vec::new();
        for &gaussians in &self.gaussians {
            for &sh_degree in &self.sh {
                let scene = Noise::new(1).scene(gaussians as usize, sh_degree);
                for size in &self.size {
                    let name = format!("{gaussians} at {size}");
                    let measured =
                        session.stage(&name, |stage| self.measure(&device, &scene, *size, &bandwidth, stage));
                    rows.extend(measured?.0);
                }
            }
        }
        session.report(&rows, format!("{}, {bandwidth}\n{}", device.limits().name, table(&rows)))
    }

    fn measure(
        &self,
        device: &Device,
        scene: &Scene,
        size: Size,
        bandwidth: &Rate,
        stage: &Stage<'_>,
    ) -> Result<Vec<Row>> {
        let (camera, request) = (noise::camera(size.0, size.1), RenderOptions::default());
        let Repeats { warmup, repeats } = self.repeats;
        // Tensor bytes are then bytes in use.
        let mut renderer = Renderer::new(device);
        renderer.render_scene(scene, &[camera], &request)?;
        let intersections = renderer.intersections();
        let mut renderer = Renderer::with_capacity(device, intersections.max(1));
        renderer.set_scene(scene)?;
        let mut host = Vec::new();
        for i in 0..warmup + repeats {
            stage.reach(f64::from(i) / f64::from(warmup + repeats))?;
            let start = Instant::now();
            renderer.render(&[camera], &request)?;
            if i >= warmup {
                host.push(start.elapsed());
            }
        }
        let start = Instant::now();
        while start.elapsed() < FULL_CLOCK {
            renderer.profile(&camera, &request)?;
        }
        let profiles = (0..repeats).map(|_| renderer.profile(&camera, &request)).collect::<Result<Vec<_>>>()?;
        let cameras = vec![camera; repeats as usize];
        let mut in_flight = Duration::ZERO;
        // The first records plans.
        for _ in 0..2 {
            let start = Instant::now();
            renderer.render_each(&cameras, &request, |_, _| stage.reach(1.0))?;
            in_flight = start.elapsed() / repeats;
        }

        let row = |Group { name, count, bytes, ms, .. }: Group| Row {
            gaussians: scene.len(),
            width: size.0,
            height: size.1,
            sh_degree: scene.sh_degree,
            intersections,
            what: name,
            commands: count,
            ms,
            frames_per_s: 1e3 / ms.median.max(1e-6),
            bytes: Some(bytes).filter(|bytes| *bytes > 0),
            bandwidth_share: bandwidth.share(ms.rate(bytes)),
        };
        let mut groups = group(&profiles, pass);
        groups.extend(group(&profiles, |_| "device".into()));
        let count = groups.last().map_or(0, |all| all.count);
        groups.push(Group { count, ..Group::of("host", Spread::of(host)) });
        groups.push(Group { count, ..Group::of("in flight", Spread::of([in_flight])) });
        if let Some(python) = &self.gsplat {
            let words = [size.0, size.1, repeats].map(|number| number.to_string());
            groups.push(Group::of("gsplat", Spread::of_ms(vec![python::GSPLAT.run(python, Some(scene), words)?])));
        }
        Ok(groups.into_iter().map(row).collect())
    }
}

fn table(rows: &[Row]) -> Table {
    let headings =
        ["pass", "Gaussians", "size", "degree", "commands", "ms: median (min..max)", "frames/s", "of bandwidth"];
    let mut table = Table::new(1, &headings);
    for row in rows {
        let what = match row.what.as_str() {
            "gsplat" => format!("gsplat, {:.2} of its time on the device", ratio(rows, row)),
            what => what.to_owned(),
        };
        table.row([
            what,
            row.gaussians.to_string(),
            Size(row.width, row.height).to_string(),
            row.sh_degree.to_string(),
            row.commands.to_string(),
            row.ms.to_string(),
            format!("{:.1}", row.frames_per_s),
            percent(row.bandwidth_share),
        ]);
    }
    table
}

fn ratio(rows: &[Row], gsplat: &Row) -> f64 {
    let case = |row: &Row| (row.gaussians, row.width, row.height, row.sh_degree);
    let ours = rows.iter().find(|row| row.what == "device" && case(row) == case(gsplat));
    ours.map_or(f64::NAN, |ours| ours.ms.median / gsplat.ms.median)
}
