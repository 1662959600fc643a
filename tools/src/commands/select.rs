use crate::{
    lifted::{self, PosedPhotos, ValueFiles},
    options::SceneInput,
    outputs::{self, Overwrite},
    session::Session,
    table::counted,
};
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use zipsplat::{
    Camera, Error, Result, SaveOptions, Scene,
    features::{FeatureRenderer, Lifted, PixelValues},
    types::{Intrinsics, Lens, PlyProperty, SceneFormat, World, read_ply_property, read_world, write_ply_with},
};

/// Least mean of a mask's values, and pixels of weight, of a Gaussian inside.
const INSIDE: f32 = 0.5;
const LEAST_PIXELS: f32 = 0.5;
/// Least weight at a pixel, relative to the largest.
const CHOSEN: f32 = 0.5;

/// Select Gaussians by masks or by a pixel, and keep or remove them
///
/// Masks alone choose the Gaussians that most of their visible pixels show inside. With --features,
/// the selection spreads from those, or from a pixel's, to neighbors with similar features.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat select scene.ply --masks masks/ --cameras transforms.json -o object.ply
  zipsplat select scene.ply --at 320,240 --view 0042.jpg --cameras transforms.json \\
      --features features.safetensors --remove -o rest.ply")]
pub struct Select {
    /// Scene (PLY, SPZ, SOG, .splat or glTF)
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Folder with a mask NAME.png for photos NAME: white is inside
    #[arg(long, value_name = "DIR", conflicts_with = "at")]
    masks: Option<PathBuf>,
    /// Pixel of a photo
    #[arg(long, value_name = "X,Y", value_parser = parse_pixel, requires = "view", requires = "features")]
    at: Option<[u32; 2]>,
    /// Photo of the pixel
    #[arg(long, value_name = "PHOTO", requires = "at")]
    view: Option<PathBuf>,
    #[command(flatten)]
    photos: PosedPhotos,
    /// Features of the scene, of `lift`
    #[arg(long, value_name = "FILE")]
    features: Option<PathBuf>,
    /// Least cosine similarity of features
    #[arg(long, value_name = "T", default_value_t = 0.8, requires = "features")]
    threshold: f32,
    /// Write the scene without the selection
    #[arg(long)]
    remove: bool,
    /// Write the whole scene with a PLY property NAME, 1 for the selection and 0 for the rest;
    /// other programs ignore it
    #[arg(long, value_name = "NAME", conflicts_with = "remove")]
    tag: Option<String>,
    /// Select Gaussians whose PLY property NAME is at least 0.5
    #[arg(long, value_name = "NAME", conflicts_with_all = ["masks", "at"])]
    tagged: Option<String>,
    /// Scene to write: .ply, .spz, .sog, .splat, .glb or .gltf
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    input: SceneInput,
}

fn parse_pixel(text: &str) -> Result<[u32; 2], String> {
    let numbers: Option<Vec<u32>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| format!("found {text}, expected X,Y in pixels"))
}

impl Select {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.overwrite.check_scene(&self.output)?;
        let is_ply = |path: &Path| SceneFormat::of_extension(path) == Some(SceneFormat::Ply);
        let lacks = [(&self.tag, &self.output), (&self.tagged, &self.scene)];
        if let Some((_, path)) = lacks.into_iter().find(|(name, path)| name.is_some() && !is_ply(path)) {
            return Err(Error::argument("PLY property", path.display(), "a .ply file"));
        }
        let (scene, _) = self.input.read(session, &self.scene)?;
        let world = read_world(&self.scene)?;
        let features = self.features.as_ref().map(|path| lifted::open(path, &scene)).transpose()?;
        let seeds = match (&self.masks, self.at, &self.tagged) {
            (Some(folder), ..) => self.inside(session, folder, &scene, world.as_ref())?,
            (None, Some(at), _) => self.behind(session, at, &scene, world.as_ref())?,
            (None, None, Some(name)) => {
                let values = read_ply_property(&self.scene, name)?;
                if values.len() != scene.len() {
                    let expected = format!("{}, without --drop-invalid", values.len());
                    return Err(Error::argument("Gaussians", scene.len(), expected));
                }
                (0..scene.len()).filter(|i| values[*i] >= INSIDE).collect()
            }
            (None, None, None) => {
                return Err(Error::argument("selection", "none", "--masks DIR, --at X,Y or --tagged NAME"));
            }
        };
        let selected = match &features {
            Some(features) => features.select(&scene, &seeds, self.threshold)?,
            None => seeds,
        };
        let mut is_selected = vec![false; scene.len()];
        selected.iter().for_each(|i| is_selected[*i] = true);
        let kept: Vec<usize> =
            (0..scene.len()).filter(|i| self.tag.is_some() || is_selected[*i] != self.remove).collect();
        if kept.is_empty() {
            let expected = "one that leaves Gaussians";
            return Err(Error::argument("selection", format!("{} of {}", selected.len(), scene.len()), expected));
        }
        let mut result = scene.clone();
        result.keep(&kept);
        match &self.tag {
            Some(name) => {
                let values: Vec<f32> = is_selected.iter().map(|is| f32::from(u8::from(*is))).collect();
                write_ply_with(&result, &self.output, world.as_ref(), &PlyProperty { name, values: &values })?;
            }
            None => {
                session.notes(outputs::save_scene(&self.output, &result, &SaveOptions::default(), world.as_ref())?);
            }
        }
        let json = json!({
            "output": self.output.to_string_lossy(), "selected": selected.len(), "input_gaussians": scene.len(), "gaussians": kept.len(),
        });
        let text = format!(
            "{}: {}, {} of {} selected",
            self.output.display(),
            counted(kept.len(), "Gaussian"),
            selected.len(),
            scene.len()
        );
        session.report(&json, text)
    }

    fn inside(
        &self,
        session: &mut Session<'_>,
        folder: &Path,
        scene: &Scene,
        world: Option<&World>,
    ) -> Result<Vec<usize>> {
        let files = ValueFiles::find(session, folder, &self.photos, world)?;
        let read = |i: usize| files.read(i, None);
        Ok(lift(session, scene, &files.cameras(), read)?.at_least(0, INSIDE, LEAST_PIXELS))
    }

    /// Gaussians with most of the weight at a pixel.
    fn behind(
        &self,
        session: &mut Session<'_>,
        [x, y]: [u32; 2],
        scene: &Scene,
        world: Option<&World>,
    ) -> Result<Vec<usize>> {
        let (capture, to_scene) = self.photos.open(session, world)?;
        let view = self.view.clone().unwrap_or_default();
        let first = capture.frames_of(std::slice::from_ref(&view))?[0];
        let Intrinsics { width, height, .. } = first.lens.map_or(first.camera.intrinsics, |lens| lens.intrinsics);
        if x >= width || y >= height {
            return Err(Error::argument("--at", format!("{x},{y}"), format!("a pixel of {width} x {height}")));
        }
        let mut nearest = (f64::INFINITY, [x, y], first);
        for frame in capture.views_of(first) {
            let Some(lens) = &frame.lens else { break };
            let (distance, at) = pinhole_pixel(lens, [x, y])?;
            if distance < nearest.0 {
                nearest = (distance, at, frame);
            }
        }
        let (_, [x, y], frame) = nearest;
        let camera = to_scene.apply(&frame.camera);
        let camera = Camera { intrinsics: camera.intrinsics.crop(x as i32, y as i32, 1, 1), ..camera };
        let one = PixelValues { width: 1, height: 1, channels: 1, values: vec![1.0] };
        let found = lift(session, scene, &[camera], |_| Ok(one.clone()))?;
        let most = found.weights.iter().copied().fold(0.0, f32::max);
        if most == 0.0 {
            return Err(Error::argument("--at", format!("no Gaussian at {x},{y}"), "a pixel that shows the scene"));
        }
        Ok(found.at_least(0, 0.0, CHOSEN * most))
    }
}

/// Pixel of a lens's pinhole picture nearest to a photo's pixel, and its distance there.
fn pinhole_pixel(lens: &Lens, [x, y]: [u32; 2]) -> Result<(f64, [u32; 2])> {
    let photo = [lens.intrinsics.width, lens.intrinsics.height];
    let (place, [width, height]) = (lens.places(photo)?, lens.view_size(photo));
    let distance = |at: &[u32; 2]| {
        let (u, v) = place(at[1] as usize, at[0] as usize);
        (u - f64::from(x) - 0.5).hypot(v - f64::from(y) - 0.5)
    };
    let pixels = (0..height).flat_map(|v| (0..width).map(move |u| [u, v]));
    let measured = pixels.map(|at| (distance(&at), at));
    Ok(measured.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, [x, y])))
}

fn lift(
    session: &mut Session<'_>,
    scene: &Scene,
    cameras: &[Camera],
    read: impl FnMut(usize) -> Result<PixelValues>,
) -> Result<Lifted> {
    let device = session.device()?;
    let (found, _) = session.stage("select", |_| FeatureRenderer::new(&device).lift(scene, cameras, 1, 1, read))?;
    Ok(found)
}
