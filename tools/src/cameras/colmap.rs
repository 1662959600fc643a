//! COLMAP's commands.

use crate::{masks::MaskArgs, process, session::Stage};
use clap::{Args, ValueEnum};
use std::{
    fmt,
    path::{Path, PathBuf},
    process::Command,
};
use zipsplat::{Error, Result};

const PYCOLMAP: &str = include_str!("pycolmap.py");
/// Named after images, with `.png` appended.
pub(super) const MASKS: &str = "masks";
pub(super) const KEYFRAMES: &str = "keyframes.txt";
pub(super) const PAIRS: &str = "pairs.txt";
/// Features per photo; matching cost is quadratic in them.
const FEATURES: u32 = 8192;
/// Photos per matching block: small ones report progress often.
const BLOCK: u32 = 8;

pub struct Colmap {
    pub program: PathBuf,
    /// By pycolmap, which cannot map keyframes.
    pub python: bool,
    version: String,
}

#[derive(Args, Clone, Default)]
pub struct Searching {
    /// COLMAP program, 3.x or 4.x [default: colmap, else pycolmap of python3]
    #[arg(long, value_name = "PROGRAM")]
    pub colmap: Option<PathBuf>,
    /// Python with pycolmap, instead of the COLMAP program
    #[arg(long, value_name = "PROGRAM", conflicts_with = "colmap")]
    pub python: Option<PathBuf>,
    /// Pairs of photos to match [default: exhaustive for up to 100 photos, else sequential]
    #[arg(long, alias = "pairs", value_enum, value_name = "WHICH")]
    pub matching: Option<Matching>,
    /// Longer side of the photos for camera estimation; COLMAP does not enlarge photos [default:
    /// 1600, 504 for Depth Anything 3, 518 for VGGT]
    #[arg(long, alias = "find-size", value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(64..=32_768))]
    pub matching_size: Option<u32>,
    #[command(flatten)]
    pub masks: MaskArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Matching {
    /// All pairs
    #[value(alias = "all")]
    Exhaustive,
    /// Neighbors in name order, such as video frames
    #[value(alias = "near")]
    Sequential,
}

impl Matching {
    /// Whether bundle adjustment ignores points that only two photos see, growth of photos or
    /// points between global ones, relative decrease of the error that ends one, most repetitions.
    /// COLMAP's defaults first, except that few photos need all points; with their tolerance of 0,
    /// a long video would take hours.
    fn bundle_adjustment(self) -> [f64; 4] {
        match self {
            Self::Exhaustive => [0.0, 1.1, 0.0, 5.0],
            Self::Sequential => [1.0, 1.4, 1e-5, 2.0],
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Step {
    Features,
    Matches,
    Cameras(Mapping),
    /// Of unmapped images.
    Registration,
}

/// Mapper settings of an attempt. COLMAP samples at random; its defaults suit much overlap.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Mapping {
    seed: u32,
    /// Smallest angle of the first pair, in degrees.
    first_angle: u32,
    /// Points that the first pair must share.
    first_points: u32,
    /// Points that a further photo must see.
    points: u32,
    pub refines_lens: bool,
    pub keyframes: bool,
}

impl Mapping {
    /// Attempts in order, COLMAP's own thresholds first.
    pub const ALL: [Self; 3] = [
        Self { seed: 0, first_angle: 16, first_points: 100, points: 30, refines_lens: true, keyframes: true },
        Self { seed: 1, first_angle: 8, first_points: 50, points: 20, refines_lens: true, keyframes: false },
        Self { seed: 2, first_angle: 4, first_points: 30, points: 15, refines_lens: true, keyframes: false },
    ];
    /// Keep the lens of EXIF or COLMAP's guess: few photos do not determine it. Some first pairs
    /// lead to a wrong minimum; the second thresholds choose another pair.
    pub const FIXED_LENS: [Self; 2] =
        [Self { refines_lens: false, ..Self::ALL[0] }, Self { refines_lens: false, keyframes: true, ..Self::ALL[2] }];
}

impl Step {
    pub fn name(self) -> &'static str {
        match self {
            Self::Features => "find features",
            Self::Matches => "match photos",
            Self::Cameras(_) | Self::Registration => "find cameras",
        }
    }
}

impl fmt::Display for Colmap {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", if self.python { "pycolmap" } else { "COLMAP" }, self.version)
    }
}

impl Colmap {
    pub fn of(searching: &Searching, stage: &Stage<'_>) -> Result<Self> {
        let tried = match (&searching.python, &searching.colmap) {
            (Some(python), _) => Self::pycolmap(python, stage),
            (None, Some(program)) => Self::native(program, stage),
            (None, None) => {
                let python = || Self::pycolmap(Path::new("python3"), stage);
                Self::native(Path::new("colmap"), stage).or_else(|why| python().map_err(|_| why))
            }
        };
        stage.check()?;
        tried.map_err(|why| {
            let expected = format!(
                "COLMAP, which finds the cameras of photos: `{}`, or `pip install pycolmap` and --python PYTHON",
                install()
            );
            Error::argument("structure from motion", why, expected)
        })
    }

    fn native(program: &Path, stage: &Stage<'_>) -> std::result::Result<Self, String> {
        let why = |why: &dyn fmt::Display| format!("{}: {why}", program.display());
        let printed = process::printed(headless(&mut Command::new(program)).arg("help"), stage);
        let printed = printed.map_err(|error| error.to_string())?;
        let version = printed.split_once("COLMAP ").and_then(|(_, rest)| rest.split_whitespace().next());
        match version.filter(|version| version.starts_with(|c: char| c.is_ascii_digit())) {
            Some(version) => Ok(Self { program: program.into(), python: false, version: version.into() }),
            None => Err(why(&format!("says no version, but {:?}", printed.lines().next().unwrap_or_default()))),
        }
    }

    fn pycolmap(program: &Path, stage: &Stage<'_>) -> std::result::Result<Self, String> {
        let why = |why: &dyn fmt::Display| format!("{}: {why}", program.display());
        let printed = process::printed(Command::new(program).args(["-c", PYCOLMAP]), stage);
        let printed = printed.map_err(|error| error.to_string())?;
        let version = printed.trim();
        if version.starts_with(|c: char| c.is_ascii_digit()) && version.lines().count() == 1 {
            return Ok(Self { program: program.into(), python: true, version: version.into() });
        }
        // A traceback ends with the reason.
        Err(why(&version.lines().last().unwrap_or("prints nothing")))
    }

    /// `folder` has `images`, may have `masks`, `keyframes.txt` and `pairs.txt`, and gets
    /// `database.db`. Models go to `models`.
    pub fn command(
        &self,
        step: Step,
        [folder, models]: [&Path; 2],
        pairs: Matching,
        side: u32,
        stage: &Stage<'_>,
    ) -> Result<Command> {
        let mut command = Command::new(&self.program);
        // Temporary files are removed with the folder.
        headless(&mut command).env("TMPDIR", folder);
        let has_pairs = folder.join(PAIRS).exists();
        if self.python {
            let words: (_, Vec<f64>) = match (step, pairs) {
                (Step::Features, _) => ("features", vec![side.into(), FEATURES.into()]),
                (Step::Matches, Matching::Exhaustive) => ("all", Vec::new()),
                (Step::Matches, Matching::Sequential) => (if has_pairs { "pairs" } else { "near" }, Vec::new()),
                (Step::Registration, _) => unreachable!("keyframes are not mapped with pycolmap"),
                (Step::Cameras(Mapping { seed, first_angle, first_points, points, refines_lens, .. }), _) => {
                    let whole = [seed, first_angle, first_points, points, refines_lens.into()].map(f64::from);
                    ("cameras", [&whole[..], &pairs.bundle_adjustment()].concat())
                }
            };
            command.args(["-c", PYCOLMAP, words.0]).args([folder, models]).args(words.1.iter().map(f64::to_string));
            return Ok(command);
        }
        let (verb, options): (_, Vec<(&[&str], f64)>) = match (step, pairs) {
            (Step::Features, _) => (
                "feature_extractor",
                vec![
                    (&["ImageReader.single_camera_per_folder"], 1.0),
                    (&["FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"], 0.0),
                    (&["FeatureExtraction.max_image_size", "SiftExtraction.max_image_size"], side.into()),
                    (&["SiftExtraction.max_num_features"], FEATURES.into()),
                ],
            ),
            (Step::Matches, Matching::Exhaustive) => (
                "exhaustive_matcher",
                vec![
                    (&["FeatureMatching.use_gpu", "SiftMatching.use_gpu"], 0.0),
                    (&["ExhaustiveMatching.block_size", "ExhaustivePairing.block_size"], BLOCK.into()),
                ],
            ),
            (Step::Matches, Matching::Sequential) => {
                let verb = if has_pairs { "matches_importer" } else { "sequential_matcher" };
                (verb, vec![(&["FeatureMatching.use_gpu", "SiftMatching.use_gpu"], 0.0)])
            }
            (Step::Cameras(mapping), _) => {
                let [ignores_pairs, growth, tolerance, repetitions] = pairs.bundle_adjustment();
                let options: Vec<(&[&str], f64)> = vec![
                    (&["Mapper.min_model_size"], 2.0),
                    (&["Mapper.random_seed", "default_random_seed", "random_seed"], mapping.seed.into()),
                    (&["Mapper.init_min_tri_angle"], mapping.first_angle.into()),
                    (&["Mapper.init_min_num_inliers"], mapping.first_points.into()),
                    (&["Mapper.abs_pose_min_num_inliers"], mapping.points.into()),
                    (&["Mapper.ba_refine_focal_length"], mapping.refines_lens.into()),
                    (&["Mapper.ba_refine_extra_params"], mapping.refines_lens.into()),
                    (&["Mapper.tri_ignore_two_view_tracks"], ignores_pairs),
                    (&["Mapper.ba_global_frames_ratio", "Mapper.ba_global_images_ratio"], growth),
                    (&["Mapper.ba_global_points_ratio"], growth),
                    (&["Mapper.ba_global_function_tolerance"], tolerance),
                    (&["Mapper.ba_local_function_tolerance"], tolerance),
                    (&["Mapper.ba_global_max_refinements"], repetitions),
                ];
                ("mapper", options)
            }
            (Step::Registration, _) => ("image_registrator", Vec::new()),
        };
        let help = process::printed(headless(&mut Command::new(&self.program)).args([verb, "-h"]), stage)?;
        let has = |name: &&&str| help.split_whitespace().any(|word| word.strip_prefix("--") == Some(**name));
        command.arg(verb).arg("--database_path").arg(folder.join("database.db"));
        match step {
            Step::Matches if has_pairs => {
                command.arg("--match_list_path").arg(folder.join(PAIRS));
            }
            Step::Matches => {}
            Step::Registration => {
                command.arg("--input_path").arg(models).arg("--output_path").arg(models);
            }
            Step::Features | Step::Cameras(_) => {
                command.arg("--image_path").arg(folder.join("images"));
            }
        }
        if step == Step::Features && folder.join(MASKS).is_dir() {
            command.arg("--ImageReader.mask_path").arg(folder.join(MASKS));
        }
        if let Step::Cameras(mapping) = step {
            command.arg("--output_path").arg(models);
            if mapping.keyframes {
                command.arg("--image_list_path").arg(folder.join(KEYFRAMES));
            }
        }
        // Option names vary by version; unknown ones are omitted.
        for (names, value) in options {
            if let Some(name) = names.iter().find(has) {
                command.args([format!("--{name}"), value.to_string()]);
            }
        }
        Ok(command)
    }
}

/// Stops Qt from needing a display: COLMAP 3 always starts it.
fn headless(command: &mut Command) -> &mut Command {
    command.env("QT_QPA_PLATFORM", "offscreen")
}

fn install() -> &'static str {
    match () {
        () if cfg!(target_os = "macos") => "brew install colmap",
        () if Path::new("/etc/debian_version").exists() => "sudo apt install --no-install-recommends colmap",
        () => "conda install -c conda-forge colmap",
    }
}
