//! `zipsplat bench render`: drawing random scenes.

use super::{Repeats, Spread, group, timed_device};
use crate::{
    noise::{self, Noise},
    options::Size,
    session::{Session, Stage},
    table::Table,
};
use clap::Args;
use serde::Serialize;
use std::time::{Duration, Instant};
use zipsplat::{
    Result,
    gpu::Device,
    stages::render::{RenderRequest, Renderer},
    types::Scene,
};

/// As many as a host has memory for.
const MOST_GAUSSIANS: i64 = 50_000_000;

/// Time of a frame, by kernel
#[derive(Args)]
pub struct Render {
    /// Numbers of Gaussians
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "36000",
        value_parser = clap::value_parser!(u32).range(1..=MOST_GAUSSIANS))]
    gaussians: Vec<u32>,
    /// Sizes of the picture
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "252x252")]
    size: Vec<Size>,
    /// Degrees of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1",
        value_parser = clap::value_parser!(u32).range(0..=i64::from(Scene::MAX_SH_DEGREE)))]
    sh: Vec<u32>,
    #[command(flatten)]
    repeats: Repeats,
}

/// Times of one scene and size, or of a kernel of it.
#[derive(Serialize)]
struct Row {
    gaussians: usize,
    width: u32,
    height: u32,
    sh_degree: u32,
    /// Kernel, `device` for all of them, or `host` for a frame in the host's memory.
    what: String,
    commands: u32,
    ms: Spread,
    frames_per_s: f64,
}

impl Render {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let device = timed_device(session)?;
        let mut rows = Vec::new();
        for &gaussians in &self.gaussians {
            for &sh_degree in &self.sh {
                let scene = Noise(0).scene(gaussians as usize, sh_degree);
                for size in &self.size {
                    let name = format!("{gaussians} at {size}");
                    rows.extend(session.stage(&name, |stage| self.measure(&device, &scene, *size, stage))?.0);
                }
            }
        }
        let headings = ["kernel", "Gaussians", "size", "degree", "commands", "ms: median (min..max)", "frames/s"];
        let mut table = Table::new(1, &headings);
        for row in &rows {
            table.row([
                row.what.clone(),
                row.gaussians.to_string(),
                Size(row.width, row.height).to_string(),
                row.sh_degree.to_string(),
                row.commands.to_string(),
                row.ms.to_string(),
                format!("{:.1}", row.frames_per_s),
            ]);
        }
        session.report(&rows, format!("{}\n{table}", device.limits().name))
    }

    fn measure(&self, device: &Device, scene: &Scene, size: Size, stage: &Stage<'_>) -> Result<Vec<Row>> {
        let Size(width, height) = size;
        let (camera, request) = (noise::camera(width, height), RenderRequest::default());
        let mut renderer = Renderer::new(device);
        renderer.load(scene)?;
        let Repeats { warmup, repeats } = self.repeats;
        let (mut host, mut profiles) = (Vec::new(), Vec::new());
        for i in 0..warmup + repeats {
            stage.reach(f64::from(i) / f64::from(warmup + repeats))?;
            let start = Instant::now();
            renderer.render_loaded(&[camera], &request)?;
            if i >= warmup {
                host.push(start.elapsed());
                profiles.push(renderer.profile(&camera, &request)?);
            }
        }
        let row = |what: &str, commands: u32, ms: Spread| Row {
            gaussians: scene.len(),
            width,
            height,
            sh_degree: scene.sh_degree,
            what: what.to_owned(),
            commands,
            ms,
            frames_per_s: 1e3 / ms.median.max(1e-6),
        };
        let kernels = group(&profiles, |row| row.kernel.clone());
        let commands = kernels.iter().map(|kernel| kernel.count).sum();
        let totals: Vec<Duration> = profiles.iter().map(|profile| profile.total("").0).collect();
        let mut rows = vec![row("host", commands, Spread::of(host)), row("device", commands, Spread::of(totals))];
        rows.extend(kernels.iter().map(|kernel| row(&kernel.name, kernel.count, kernel.ms)));
        Ok(rows)
    }
}
