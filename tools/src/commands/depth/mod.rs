mod truth;

use crate::{
    cameras::{ModelOption, path_from},
    depth::{CamerasFrom, PredictedViews, PredictorOptions},
    file_names::{self, unique_stems},
    known_depth::{PHOTOS, VALUES},
    masks::MaskArgs,
    options::ArithmeticOption,
    outputs::{Overwrite, check_folder, make_folder, save_depth, save_picture},
    photos::{self, PhotoArgs},
    released::open_depth,
    session::{Session, stage_seconds},
    table::{counted, time},
    video::FrameFolder,
};
use clap::Args;
use safetensors::{Dtype, tensor::TensorView};
use serde_json::json;
use std::{
    collections::HashMap,
    ops::Range,
    path::{Path, PathBuf},
    time::Duration,
};
use truth::{Errors, Truth};
use zipsplat::{
    Error, Image, Result,
    depth::{DepthMap, DepthOptions, DepthPrediction},
    types::{
        MAX_VIEW_DEG,
        poses::{Capture, CaptureView, write_frames},
        write_atomic, write_points,
    },
    weights::DepthHeads,
};

/// Predict depth, points and cameras of photos with Depth Anything 3 or VGGT
///
/// Writes depths.safetensors (depth, confidence and rays), and 16-bit and color pictures of depth.
/// Multi-view networks also write transforms.json for --cameras of `reconstruct` and `refine`, and
/// points.ply for `refine --init points`. Lengths are in the network's unit.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat depth photos/ --weights da3-small -o depth/
  zipsplat refine --init points photos/ --cameras depth/transforms.json -o scene.ply
  zipsplat reconstruct photos/ --cameras depth/transforms.json -o scene.ply
  zipsplat depth photos/ --weights da3-base.safetensors --cameras transforms.json -o depth/
  zipsplat depth capture/images --weights da3-base.safetensors --ground-truth capture/ -o depth/")]
pub struct Depth {
    #[command(flatten)]
    input: PhotoArgs,
    /// Weights of Depth Anything 3 or VGGT: a name (da3-small, da3-base, da3-large, da3-giant,
    /// da3mono-large, da3metric-large, vggt-1b), a released model.safetensors or model.pt, or
    /// seeded:NAME for random numbers
    #[arg(long, value_name = "NAME|PATH|seeded:NAME")]
    weights: String,
    /// Folder to write to
    #[arg(long, short, value_name = "FOLDER")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Known cameras of all photos: input of Depth Anything 3's multi-view networks; with its
    /// others they place the points
    #[arg(long, value_name = "FILE")]
    cameras: Option<PathBuf>,
    #[command(flatten)]
    source: CamerasFrom,
    /// Depth in meters, by da3metric-large and cameras with positions in meters. Otherwise depth of
    /// single-view networks is aligned to the cameras' points
    #[arg(long, alias = "metres", requires = "cameras")]
    metric: bool,
    /// Also run VGGT's point head, for world points and confidence in depths.safetensors and in
    /// points.ply
    #[arg(long)]
    point_head: bool,
    /// Photo whose camera is the world, counted from 0 [default: the network's choice]
    #[arg(long, value_name = "N")]
    reference_view: Option<usize>,
    /// Longer side of the photos in pixels, for VGGT their width [default: 504, for VGGT 518]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(14..=8192))]
    input_size: Option<u32>,
    /// Largest number of points in points.ply
    #[arg(long, alias = "points", value_name = "N", default_value = "200000")]
    max_points: usize,
    /// Largest number of photos or video frames, evenly spaced [default: all photos, 24 frames of a
    /// video]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views: Option<u32>,
    #[command(flatten)]
    model: ModelOption,
    /// Also print errors relative to this capture: its transforms.json or COLMAP model, and any
    /// depth/NAME.npy (f32 [height, width], z in the cameras' unit)
    #[arg(long, alias = "truth", value_name = "CAPTURE")]
    ground_truth: Option<PathBuf>,
    #[command(flatten)]
    arithmetic: ArithmeticOption,
}

const CAMERAS: &str = "transforms.json";
const POINTS: &str = "points.ply";

impl Depth {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let checkpoint = open_depth(&self.weights, DepthHeads { points: self.point_head, ..DepthHeads::default() })?;
        let place = self.output.join(CAMERAS);
        let (no_masks, named_in) = (MaskArgs::default(), Some((&*place, self.overwrite)));
        let unposed = self.cameras.is_none().then_some(&no_masks);
        let (files, mut folder) = self.input.list(session, self.views, unposed, named_in)?;
        let files = photos::spread(files, self.views.filter(|_| unposed.is_none()));
        let known = self.known(&files)?;
        self.check(&files)?;
        self.model.check_names(&files)?;
        let truth = self.ground_truth.as_deref().map(Truth::open).transpose()?;
        let request = DepthOptions { reference_view: self.reference_view, ..Default::default() };
        let of_network = PredictorOptions::of(&checkpoint, &self.arithmetic);
        let options = PredictorOptions { side: self.input_size, cameras: self.source, request, ..of_network };
        let frames: Vec<&CaptureView> = known.iter().flat_map(|(frames, _)| frames).collect();
        let mut predicted = options.ask(session, &files, &frames)?;
        predicted.scale(self.metric, known.as_ref().and_then(|(_, points)| points.as_deref()))?;
        let errors = truth.map(|truth| truth.errors(&predicted, self.cameras.is_none())).transpose()?;
        if !predicted.lost.is_empty() {
            session.note(format!("without a camera, and left out: {}", file_names::names(&predicted.lost)));
        }

        make_folder(&self.output)?;
        let names = unique_stems(&predicted.photos);
        let frames = known.map_or_else(|| predicted.frames(), |(frames, _)| Ok(frames))?;
        save_values(&self.output.join(VALUES), &predicted.depths, &names)?;
        let levels = self.save_pictures(&predicted.depths, &names)?;
        let points = predicted.points(self.max_points);
        let cloud = self.output.join(POINTS);
        if predicted.cameras.is_some() {
            write_points(&cloud, &points)?;
            let named = |(frame, file): (&CaptureView, &PathBuf)| {
                Ok(CaptureView { name: path_from(&self.output, file)?, ..frame.clone() })
            };
            let named = frames.iter().zip(&predicted.photos).map(named).collect::<Result<Vec<_>>>()?;
            write_frames(place, &named, Some(POINTS))?;
        }
        folder.iter_mut().for_each(FrameFolder::keep);
        if predicted.cameras.is_some() {
            self.model.save(&frames, Some(&cloud))?;
        }
        self.report(session, &predicted, levels, points.len(), errors.as_ref())
    }

    fn report(
        &self,
        session: &mut Session<'_>,
        predicted: &PredictedViews,
        levels: f32,
        points: usize,
        errors: Option<&Errors>,
    ) -> Result<()> {
        let PredictedViews { depths, cameras, times, .. } = predicted;
        let total: Duration = times.iter().map(|(_, took)| *took).sum();
        let json = json!({
            "output": self.output.to_string_lossy(), "network": predicted.network, "views": depths.views.len(),
            "width": depths.width, "height": depths.height, "depth_levels_per_unit": levels, "points": points,
            "has_cameras": cameras.is_some(), "peak_bytes": depths.peak_bytes, "seconds": total.as_secs_f64(),
            "stage_seconds": stage_seconds(times),
            "errors": errors.map(Errors::as_json),
        });
        let took = times.last().map(|(_, took)| time(*took)).unwrap_or_default();
        let more = cameras.as_ref().map_or(String::new(), |_| format!(", their cameras, {}", counted(points, "point")));
        let (output, size) = (self.output.display(), format!("{} x {}", depths.width, depths.height));
        let text = format!("{output}: depth of {} at {size} in {took}{more}", counted(depths.views.len(), "view"));
        let text = text + &errors.map_or_else(String::new, |errors| format!("\n{}", errors.summary()));
        session.report(&json, text)
    }

    fn check(&self, files: &[PathBuf]) -> Result<()> {
        let names = unique_stems(files);
        let pictures = names.iter().flat_map(|name| [picture(name, "depth"), picture(name, "colors")]);
        let all = pictures.chain([VALUES, CAMERAS, POINTS].map(String::from)).map(|name| self.output.join(name));
        check_folder(&self.output)?;
        self.overwrite.check_replaced(all)?;
        self.model.check(self.overwrite)?;
        match self.reference_view.filter(|photo| *photo >= files.len()) {
            Some(photo) => {
                Err(Error::argument("--reference-view", photo, format!("0 to {}, the photos", files.len() - 1)))
            }
            None => Ok(()),
        }
    }

    fn known(&self, files: &[PathBuf]) -> Result<Option<(Vec<CaptureView>, Option<PathBuf>)>> {
        let Some(poses) = &self.cameras else { return Ok(None) };
        let mut poses = Capture::open(poses)?;
        poses.attach(files)?;
        let frames = poses.frames_of(files)?;
        if let Some(wide) = frames.iter().find(|frame| poses.views_of(frame).len() > 1) {
            let expected = format!("up to {MAX_VIEW_DEG} degrees; reconstruct and refine take wider ones");
            return Err(Error::argument(format!("field of view of {}", wide.name), "a wider lens", expected));
        }
        Ok(Some((frames.into_iter().cloned().collect(), poses.points)))
    }

    /// Returns the levels per unit, of all pictures.
    fn save_pictures(&self, depths: &DepthPrediction, names: &[String]) -> Result<f32> {
        let size = [depths.width, depths.height];
        let behind: Vec<Vec<f32>> = depths.views.iter().map(DepthMap::depth_behind_sky).collect();
        let farthest = behind.iter().flatten().copied().filter(|depth| depth.is_finite()).fold(0.0, f32::max);
        let levels = f32::from(u16::MAX) / farthest.max(f32::MIN_POSITIVE);
        for (name, depth) in names.iter().zip(&behind) {
            save_depth(&self.output.join(picture(name, "depth")), size, depth, levels)?;
            save_picture(&self.output.join(picture(name, "colors")), &colored(depth, size)?)?;
        }
        Ok(levels)
    }
}

fn picture(name: &str, what: &str) -> String {
    format!("{name}.{what}.png")
}

/// Writes `depth` and `confidence` `[views, height, width]`, `rays` `[views, rows, columns, 6]`
/// (direction, origin), `ray_confidence`, `sky`, `points` `[views, height, width, 3]`,
/// `point_confidence`, and photo names as metadata.
fn save_values(path: &Path, depths: &DepthPrediction, names: &[String]) -> Result<()> {
    let (views, size) = (depths.views.len(), [depths.height as usize, depths.width as usize]);
    let all = |of: &dyn Fn(&DepthMap) -> Option<Vec<f32>>| {
        depths.views.iter().map(of).collect::<Option<Vec<_>>>().map(|values| values.concat())
    };
    let rays = |view: &DepthMap| {
        let rays = view.rays.as_ref()?;
        Some(rays.directions.iter().zip(&rays.origins).flat_map(|(d, o)| [*d, *o].concat()).collect())
    };
    let of_points =
        |all: &[[f32; 4]], values: Range<usize>| all.iter().flat_map(|v| v[values.clone()].to_vec()).collect();
    let grid = depths.views.first().and_then(|view| view.rays.as_ref());
    let grid = grid.map_or([0; 2], |rays| [rays.height as usize, rays.width as usize]);
    let full = [&[views], &size[..]].concat();
    let tensors = [
        ("depth", full.clone(), all(&|view| Some(view.depth.clone()))),
        ("confidence", full.clone(), all(&|view| view.confidence.clone())),
        ("sky", full.clone(), all(&|view| view.sky.clone())),
        ("rays", [&[views], &grid[..], &[6]].concat(), all(&rays)),
        ("points", [&full[..], &[3]].concat(), all(&|view| view.points.as_ref().map(|all| of_points(all, 0..3)))),
        ("point_confidence", full.clone(), all(&|view| view.points.as_ref().map(|all| of_points(all, 3..4)))),
        ("ray_confidence", [&[views], &grid[..]].concat(), all(&|view| Some(view.rays.as_ref()?.confidence.clone()))),
    ];
    let stored = |values: Vec<f32>| values.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let there = tensors.into_iter().filter_map(|(name, shape, values)| Some((name, shape, stored(values?))));
    let there: Vec<_> = there.collect();
    let views = there.iter().map(|(name, shape, bytes)| {
        (*name, TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as the shape has"))
    });
    // One entry: several would have no fixed order.
    let photos = serde_json::to_string(names).expect("names are text");
    let metadata = HashMap::from([(PHOTOS.to_owned(), photos)]);
    let file =
        safetensors::serialize(views, Some(metadata)).map_err(|error| Error::format(path, None, error.to_string()))?;
    write_atomic(path, |out| out.write_all(&file))
}

const COLORS: [[f64; 3]; 6] = [
    [250.0, 230.0, 120.0],
    [245.0, 150.0, 70.0],
    [205.0, 75.0, 90.0],
    [125.0, 50.0, 130.0],
    [55.0, 45.0, 115.0],
    [15.0, 15.0, 50.0],
];

/// Spans the 2nd to 98th percentiles of inverse depth.
fn colored(depth: &[f32], [width, height]: [u32; 2]) -> Result<Image> {
    let nearness: Vec<f64> = depth.iter().map(|&depth| 1.0 / f64::from(depth.max(f32::MIN_POSITIVE))).collect();
    let mut sorted = nearness.clone();
    sorted.sort_by(f64::total_cmp);
    let [least, most] = [0.02, 0.98].map(|share| sorted[(share * (sorted.len() - 1) as f64) as usize]);
    let color = |nearness: &f64| {
        let far = (most - nearness) / (most - least).max(f64::MIN_POSITIVE);
        let place = far.clamp(0.0, 1.0) * (COLORS.len() - 1) as f64;
        let (first, share) =
            ((place as usize).min(COLORS.len() - 2), place - place.floor().min((COLORS.len() - 2) as f64));
        [0, 1, 2].map(|c| (COLORS[first][c] + share * (COLORS[first + 1][c] - COLORS[first][c])).round() as u8)
    };
    Image::new(width, height, nearness.iter().flat_map(color).collect())
}
