//! `zipsplat depth`: depth, points and cameras of photos, by a network of Depth Anything 3.

use crate::{
    cameras::path_from,
    options::ArithmeticOption,
    outputs::{Overwrite, check_folder, make_folder, save_depth_levels, save_picture},
    photos::{self, PhotoArgs},
    session::{Session, Stage},
    table::{counted, time},
    video::FrameFolder,
};
use clap::{Args, ValueEnum};
use safetensors::{Dtype, tensor::TensorView};
use serde_json::json;
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};
use zipsplat::{
    Camera, Error, Image, Result,
    depth::{DepthModel, DepthRequest, DepthView, Depths},
    gpu::Progress,
    types::{
        bounded_views,
        poses::{Frame, read_poses, write_frames},
        preprocess::View,
        write_atomic, write_points,
    },
    weights::DepthCheckpoint,
};

/// Depth, points and cameras of photos that may have none, by Depth Anything 3
///
/// The folder gets depths.safetensors (depth, confidence and rays of all views), and of each photo a picture of its depth in 16 bits and one
/// in colours. Networks that see all photos at once also give transforms.json, the photos' cameras, and points.ply: `reconstruct`
/// and `refine` take the one as --poses, and `refine --start points` begins from the other. Lengths are in a unit of the network's.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat depth photos/ --weights da3-base.safetensors -o depth/
  zipsplat refine --start points photos/ --poses depth/transforms.json -o scene.ply
  zipsplat reconstruct photos/ --poses depth/transforms.json -o scene.ply
  zipsplat depth photos/ --weights da3-base.safetensors --poses transforms.json -o depth/")]
pub struct Depth {
    #[command(flatten)]
    input: PhotoArgs,
    /// Weights of Depth Anything 3 as they are released (model.safetensors of da3-small, da3-base, da3-large, da3-giant,
    /// da3mono-large or da3metric-large), or seeded:NAME for random numbers
    #[arg(long, value_name = "PATH|seeded:NAME")]
    weights: String,
    /// Folder to write to
    #[arg(long, short, value_name = "FOLDER")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Known cameras of all photos, for networks that see all photos at once
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// How cameras follow from what the network says
    #[arg(long, value_enum, value_name = "HOW", default_value = "decoder")]
    cameras: CamerasFrom,
    /// The photo, counted from 1, that the world is about [default: the network's choice]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    reference: Option<u32>,
    /// Longer side of the photos as the network sees them, in pixels
    #[arg(long, value_name = "PIXELS", default_value = "504", value_parser = clap::value_parser!(u32).range(14..=8192))]
    size: u32,
    /// Points at most
    #[arg(long, value_name = "N", default_value = "200000")]
    points: usize,
    /// Take at most so many of the photos, evenly spread, and so many frames of a video [default: all, and 24 of a video]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views: Option<u32>,
    #[command(flatten)]
    arithmetic: ArithmeticOption,
}

/// The source of cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum CamerasFrom {
    /// The network's camera decoder
    Decoder,
    /// The rays of all pixels, with a principal point of their own
    Rays,
}

/// Files of the folder.
const VALUES: &str = "depths.safetensors";
const CAMERAS: &str = "transforms.json";
const POINTS: &str = "points.ply";

/// The photos of a run.
struct Photos {
    files: Vec<PathBuf>,
    /// What their pictures are called.
    names: Vec<String>,
    /// Their frames among known cameras.
    known: Option<Vec<Frame>>,
    /// As the network sees them.
    views: Vec<View>,
    /// Those views' known cameras.
    cameras: Option<Vec<Camera>>,
}

impl Depth {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let checkpoint = DepthCheckpoint::parse(&self.weights, false)?;
        let place = self.output.join(CAMERAS);
        let (files, mut folder) = self.input.list(session, self.views, Some((&place, self.overwrite)))?;
        let photos = self.photos(session, files)?;
        let images: Vec<Image> = photos.views.iter().map(|view| view.image.clone()).collect();

        let device = session.device()?;
        let (_, arithmetic) = self.arithmetic.choose(session, &device)?;
        let load = |stage: &Stage<'_>| DepthModel::load(&device, &checkpoint, arithmetic, |done| stage.at(done));
        let (model, loaded) = session.stage("load weights", load)?;
        let reference = self.reference.map(|photo| photo as usize - 1);
        let request = DepthRequest { cameras: photos.cameras.clone(), reference };
        let (mut depths, took) = session.stage("depth", |stage| {
            model.depths(&images, &request, |progress: Progress<'_>| {
                stage.name(progress.scope);
                stage.at(progress.fraction)
            })
        })?;
        let cameras = match &photos.cameras {
            Some(cameras) => {
                if let Err(error) = depths.bring_to(cameras) {
                    session.note(format!("lengths stay in the network's unit: {error}"));
                }
                Some(cameras.clone())
            }
            None if model.architecture().multi_view() => Some(self.cameras_of(&depths)?),
            None => None,
        };

        make_folder(&self.output)?;
        let frames = cameras.as_ref().map(|cameras| self.frames(&photos, cameras)).transpose()?;
        save_values(&self.output.join(VALUES), &depths, &photos.names)?;
        let levels = self.save_pictures(&depths, &photos.names)?;
        let mut points = Vec::new();
        if let (Some(cameras), Some(frames)) = (&cameras, frames) {
            points = depths.points(cameras, &images, self.points);
            write_points(self.output.join(POINTS), &points)?;
            write_frames(place, &frames, Some(POINTS))?;
        }
        folder.iter_mut().for_each(FrameFolder::keep);
        let json = json!({
            "output": self.output, "network": model.architecture().name, "views": images.len(),
            "width": depths.width, "height": depths.height, "levels_per_unit": levels, "points": points.len(),
            "cameras": cameras.is_some(), "peak_bytes": depths.peak_bytes,
            "seconds": { "load": loaded.as_secs_f64(), "depth": took.as_secs_f64() },
        });
        let more = cameras.map_or(String::new(), |_| format!(", their cameras, {}", counted(points.len(), "point")));
        let (output, size) = (self.output.display(), format!("{} x {}", depths.width, depths.height));
        let text = format!("{output}: depth of {} at {size} in {}{more}", counted(images.len(), "view"), time(took));
        session.report(&json, text)
    }

    /// The photos, once it is sure that what is made of them can be written.
    fn photos(&self, session: &mut Session<'_>, files: Vec<PathBuf>) -> Result<Photos> {
        let files = self.views.map_or(files.clone(), |views| photos::spread(files, views as usize));
        let names = names(&files);
        let pictures = names.iter().flat_map(|name| [picture(name, "depth"), picture(name, "colors")]);
        let all = pictures.chain([VALUES, CAMERAS, POINTS].map(String::from)).map(|name| self.output.join(name));
        check_folder(&self.output)?;
        self.overwrite.check_replaced(all)?;
        if let Some(photo) = self.reference.filter(|photo| *photo as usize > files.len()) {
            return Err(Error::argument("--reference", photo, format!("1 to {}, the photos", files.len())));
        }
        let known = self.poses.as_ref().map(|poses| frames_of(poses, &files)).transpose()?;
        let frames: Vec<&Frame> = known.iter().flatten().collect();
        let (seen, _) =
            session.stage("read photos", |stage| photos::read(&files, &frames, stage, |_, photo| Ok(photo)))?;
        let views = bounded_views(&seen, self.size)?;
        let cameras = known.as_ref().map(|frames| of_views(frames, &views)).transpose()?;
        Ok(Photos { files, names, known, views, cameras })
    }

    /// The photos' frames: known ones, or cameras of their views as those of the photos as they are stored.
    fn frames(&self, photos: &Photos, cameras: &[Camera]) -> Result<Vec<Frame>> {
        let frame = |(i, file): (usize, &PathBuf)| {
            let name = path_from(&self.output, file)?;
            if let Some(known) = &photos.known {
                return Ok(Frame { name, ..known[i].clone() });
            }
            let upright = Camera { intrinsics: photos.views[i].map.undo(&cameras[i].intrinsics), ..cameras[i] };
            Ok(Frame { name, photo: None, camera: Image::camera_as_stored(file, &upright)?, lens: None })
        };
        photos.files.iter().enumerate().map(frame).collect()
    }

    /// The cameras that the network says.
    fn cameras_of(&self, depths: &Depths) -> Result<Vec<Camera>> {
        match self.cameras {
            CamerasFrom::Decoder => depths.cameras(),
            CamerasFrom::Rays => depths.cameras_of_rays()?.into_iter().map(|found| Ok(found?.camera)).collect(),
        }
    }

    /// Writes depths in 16 bits, one scale for all, and colours of each by itself; gives the levels of a unit.
    fn save_pictures(&self, depths: &Depths, names: &[String]) -> Result<f32> {
        let size = [depths.width, depths.height];
        let behind: Vec<Vec<f32>> = depths.views.iter().map(DepthView::depth_behind_sky).collect();
        let farthest = behind.iter().flatten().copied().filter(|depth| depth.is_finite()).fold(0.0, f32::max);
        let levels = f32::from(u16::MAX) / farthest.max(f32::MIN_POSITIVE);
        for (name, depth) in names.iter().zip(&behind) {
            save_depth_levels(&self.output.join(picture(name, "depth")), size, depth, levels)?;
            save_picture(&self.output.join(picture(name, "colors")), &colored(depth, size)?)?;
        }
        Ok(levels)
    }
}

/// The known cameras of photos.
fn frames_of(poses: &Path, files: &[PathBuf]) -> Result<Vec<Frame>> {
    Ok(read_poses(poses)?.frames_of(files)?.into_iter().cloned().collect())
}

/// Known cameras of photos as those of their views.
fn of_views(frames: &[Frame], views: &[View]) -> Result<Vec<Camera>> {
    let camera = |(frame, view): (&Frame, &View)| {
        Ok(Camera { intrinsics: view.map.apply(&frame.camera.intrinsics, &frame.name)?, ..frame.camera })
    };
    frames.iter().zip(views).map(camera).collect()
}

/// What files of photos are called by: their names, with their number where several share one.
fn names(files: &[PathBuf]) -> Vec<String> {
    let stem = |file: &PathBuf| file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let stems: Vec<String> = files.iter().map(stem).collect();
    let name = |(i, stem): (usize, &String)| match stems.iter().filter(|other| *other == stem).count() {
        1 => stem.clone(),
        _ => format!("{stem}-{}", i + 1),
    };
    stems.iter().enumerate().map(name).collect()
}

fn picture(name: &str, what: &str) -> String {
    format!("{name}.{what}.png")
}

/// Writes what the network said: `depth` and `confidence` `[views, height, width]`, `rays` `[views, rows, columns, 6]` (direction, origin)
/// with their `ray_confidence`, `sky`; the photos' names as metadata.
fn save_values(path: &Path, depths: &Depths, names: &[String]) -> Result<()> {
    let (views, size) = (depths.views.len(), [depths.height as usize, depths.width as usize]);
    let all = |of: &dyn Fn(&DepthView) -> Option<Vec<f32>>| {
        depths.views.iter().map(of).collect::<Option<Vec<_>>>().map(|values| values.concat())
    };
    let rays = |view: &DepthView| {
        let rays = view.rays.as_ref()?;
        Some(rays.directions.iter().zip(&rays.origins).flat_map(|(d, o)| [*d, *o].concat()).collect())
    };
    let grid = depths.views.first().and_then(|view| view.rays.as_ref());
    let grid = grid.map_or([0; 2], |rays| [rays.height as usize, rays.width as usize]);
    let full = [&[views], &size[..]].concat();
    let tensors = [
        ("depth", full.clone(), all(&|view| Some(view.depth.clone()))),
        ("confidence", full.clone(), all(&|view| view.confidence.clone())),
        ("sky", full, all(&|view| view.sky.clone())),
        ("rays", [&[views], &grid[..], &[6]].concat(), all(&rays)),
        ("ray_confidence", [&[views], &grid[..]].concat(), all(&|view| Some(view.rays.as_ref()?.confidence.clone()))),
    ];
    let stored = |values: Vec<f32>| values.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let there = tensors.into_iter().filter_map(|(name, shape, values)| Some((name, shape, stored(values?))));
    let there: Vec<_> = there.collect();
    let views = there.iter().map(|(name, shape, bytes)| {
        (*name, TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as the shape has"))
    });
    // One entry: of several the order would differ from run to run.
    let photos = serde_json::to_string(names).expect("names are text");
    let metadata = HashMap::from([("zipsplat.photos".to_owned(), photos)]);
    let file =
        safetensors::serialize(views, Some(metadata)).map_err(|error| Error::format(path, None, error.to_string()))?;
    write_atomic(path, |out| out.write_all(&file))
}

/// Colours from near to far.
const COLORS: [[f64; 3]; 6] = [
    [250.0, 230.0, 120.0],
    [245.0, 150.0, 70.0],
    [205.0, 75.0, 90.0],
    [125.0, 50.0, 130.0],
    [55.0, 45.0, 115.0],
    [15.0, 15.0, 50.0],
];

/// Depth in colours: by how near a pixel is, between the nearest and the farthest fiftieth.
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
