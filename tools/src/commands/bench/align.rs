use super::Spread;
use crate::{
    align::{Aligned, Method},
    options::Size,
    procedural::{Capture, Options, Photos, Setup},
    session::{Session, Stage},
    table::Table,
};
use clap::{Args, ValueEnum};
use glam::{DMat3, DQuat};
use serde::Serialize;
use std::time::Instant;
use zipsplat::{
    Result,
    stages::render::Renderer,
    types::{Camera, Pose},
};

/// One photo in this number is aligned; the others make the scene.
const ALIGNED_OF: usize = 3;

/// Recovery of perturbed cameras by each way of `eval --align`, on procedural places
///
/// Held-out cameras are rotated and moved, then aligned to a scene of the other photos with exact
/// depth. Errors are medians over all photos: degrees, and shifts in percent of the scene's
/// distance.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat bench align
  zipsplat bench align --seeds 10,11,12 --size 126x126 --degrees 1,4")]
pub struct Align {
    /// Seeds of the places
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1,2,3,4")]
    seeds: Vec<u64>,
    /// Photos of a place
    #[arg(long, value_name = "N", default_value = "12", value_parser = clap::value_parser!(u32).range(3..=64))]
    views: u32,
    /// Size of the photos
    #[arg(long, value_name = "WxH", default_value = "84x84")]
    size: Size,
    /// Degrees of rotation error; also the shift in percent
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1,2,5")]
    degrees: Vec<f64>,
}

#[derive(Serialize)]
struct Row {
    method: &'static str,
    photos: usize,
    start: f64,
    degrees: f64,
    percent: f64,
    /// Photos whose angle and position both improved.
    nearer: usize,
    ms: Spread,
}

impl Align {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let options = Options {
            views: self.views as usize,
            width: self.size.0,
            height: self.size.1,
            supersample: false,
            random_first: false,
        };
        options.validate()?;
        let device = session.device()?;
        let mut renderer = Renderer::new(&device);
        let photos = Photos::default();
        let (captures, _) = session.stage("take photos", |stage| {
            let go_on = || stage.check();
            stage.each(&self.seeds, |seed| Setup::new(*seed, &options, &photos, &go_on)?.shoot(&photos, &go_on))
        })?;
        let mut rows = Vec::new();
        for &start in &self.degrees {
            for method in Method::value_variants() {
                let name = format!("{method:?} from {start} degrees");
                rows.push(session.stage(&name, |stage| row(&mut renderer, &captures, *method, start, stage))?.0);
            }
        }
        let text = format!("{}, photos of {}\n{}", device.limits().name, self.size, table(&rows));
        session.report(&rows, text)
    }
}

fn row(renderer: &mut Renderer, captures: &[Capture], method: Method, start: f64, stage: &Stage<'_>) -> Result<Row> {
    let (mut degrees, mut percents, mut times, mut nearer) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for (k, capture) in captures.iter().enumerate() {
        stage.reach(k as f64 / captures.len() as f64)?;
        let aligned = |i: &usize| i % ALIGNED_OF == 1;
        renderer.set_scene(&capture.splats_of((0..capture.images.len()).filter(|i| !aligned(i))))?;
        for i in (0..capture.images.len()).filter(aligned) {
            let truth = capture.cameras[i];
            let from = Camera { pose: truth.pose.compose(&wrong(i, start)), ..truth };
            let begin = Instant::now();
            let Aligned { camera, .. } = method.align(renderer, &capture.images[i], &from, None, &|| stage.check())?;
            times.push(begin.elapsed());
            let [turn, shift] = between(&truth.pose, &camera.pose);
            nearer += usize::from(turn < start && shift < start);
            degrees.push(turn);
            percents.push(shift);
        }
    }
    let (photos, ms) = (times.len(), Spread::of(times));
    let name = if method == Method::Adam { "Adam" } else { "Levenberg-Marquardt" };
    Ok(Row { method: name, photos, start, degrees: median(degrees), percent: median(percents), nearer, ms })
}

/// Returns a rotation by `degrees`, and a shift by as many percent of distance 1.
fn wrong(i: usize, degrees: f64) -> Pose {
    let [axis, direction] = [2 * i, 2 * i + 1].map(crate::capture::spread);
    Pose { rotation: DMat3::from_axis_angle(axis, degrees.to_radians()), translation: degrees / 100.0 * direction }
}

/// Returns degrees, and percent of distance 1.
fn between(a: &Pose, b: &Pose) -> [f64; 2] {
    let movement = b.relative_to(a);
    let turn = DQuat::from_mat3(&movement.rotation).to_scaled_axis().length().to_degrees();
    [turn, 100.0 * movement.translation.length()]
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn table(rows: &[Row]) -> Table {
    let headings = ["method", "wrong by", "photos", "nearer", "degrees", "percent", "ms a photo: median (min..max)"];
    let mut table = Table::new(1, &headings);
    for row in rows {
        table.row([
            row.method.to_owned(),
            format!("{} degrees, {} %", row.start, row.start),
            row.photos.to_string(),
            row.nearer.to_string(),
            format!("{:.3}", row.degrees),
            format!("{:.3}", row.percent),
            row.ms.to_string(),
        ]);
    }
    table
}
