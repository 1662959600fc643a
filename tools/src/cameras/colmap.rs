//! COLMAP's commands, and progress from its output.

use crate::{masks::MaskArgs, process, session::Stage};
use clap::{Args, ValueEnum};
use std::{
    fmt,
    path::{Path, PathBuf},
    process::{Command, ExitStatus},
};
use zipsplat::{Error, Result};

const PYCOLMAP: &str = include_str!("pycolmap.py");
/// Named after images, with `.png` appended.
pub(super) const MASKS: &str = "masks";
/// Features per photo; matching cost is quadratic in them.
const FEATURES: u32 = 8192;
/// Photos per matching block: smaller blocks report progress more often.
const BLOCK: u32 = 8;

pub struct Colmap {
    program: PathBuf,
    python: bool,
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
    #[arg(long, value_enum, value_name = "WHICH")]
    pub matching: Option<Matching>,
    /// Longer side of the photos for camera estimation; COLMAP does not enlarge photos [default:
    /// 1600, 504 for Depth Anything 3, 518 for VGGT]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(64..=32_768))]
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
    /// Settings of bundle adjustment: whether it ignores points that only two photos see, growth of
    /// the number of photos or points after which it is global, relative decrease of the error that
    /// ends it, and number of repetitions. First COLMAP's defaults, but few photos need all points.
    /// With them, a long video takes hours in which the error hardly decreases.
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
}

#[derive(Default)]
pub struct ColmapOutput {
    pub features: Vec<usize>,
    pub pairs: Option<usize>,
    no_start: bool,
    /// The disk was full; COLMAP 3 reports that without failing.
    pub no_room: bool,
    pairs_follow: bool,
    last: Vec<String>,
}

/// Log lines in an error.
const LAST: usize = 3;

impl Mapping {
    /// Attempts in order, COLMAP's own thresholds first.
    pub const ALL: [Self; 3] = [
        Self { seed: 0, first_angle: 16, first_points: 100, points: 30, refines_lens: true },
        Self { seed: 1, first_angle: 8, first_points: 50, points: 20, refines_lens: true },
        Self { seed: 2, first_angle: 4, first_points: 30, points: 15, refines_lens: true },
    ];
    /// Keep the lens of EXIF or COLMAP's guess: few photos do not determine it. From some first
    /// pairs, bundle adjustment ends in a wrong minimum; the second thresholds choose another pair.
    pub const FIXED_LENS: [Self; 2] =
        [Self { refines_lens: false, ..Self::ALL[0] }, Self { refines_lens: false, ..Self::ALL[2] }];
}

impl Step {
    pub fn name(self) -> &'static str {
        match self {
            Self::Features => "find features",
            Self::Matches => "match photos",
            Self::Cameras(_) => "find cameras",
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

    pub fn program(&self) -> &Path {
        &self.program
    }

    /// `folder` has `images`, may have `masks` and gets `database.db`; models go to `models`.
    pub fn command(
        &self,
        step: Step,
        [folder, models]: [&Path; 2],
        (pairs, side): (Matching, u32),
        stage: &Stage<'_>,
    ) -> Result<Command> {
        let mut command = Command::new(&self.program);
        // Temporary files are removed with the folder.
        headless(&mut command).env("TMPDIR", folder);
        if self.python {
            let words: (_, Vec<f64>) = match (step, pairs) {
                (Step::Features, _) => ("features", vec![side.into(), FEATURES.into()]),
                (Step::Matches, Matching::Exhaustive) => ("all", Vec::new()),
                (Step::Matches, Matching::Sequential) => ("near", Vec::new()),
                (Step::Cameras(Mapping { seed, first_angle, first_points, points, refines_lens }), _) => {
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
                ("sequential_matcher", vec![(&["FeatureMatching.use_gpu", "SiftMatching.use_gpu"], 0.0)])
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
        };
        let help = process::printed(headless(&mut Command::new(&self.program)).args([verb, "-h"]), stage)?;
        let has = |name: &&&str| help.split_whitespace().any(|word| word.strip_prefix("--") == Some(**name));
        command.arg(verb).arg("--database_path").arg(folder.join("database.db"));
        if step != Step::Matches {
            command.arg("--image_path").arg(folder.join("images"));
        }
        if step == Step::Features && folder.join(MASKS).is_dir() {
            command.arg("--ImageReader.mask_path").arg(folder.join(MASKS));
        }
        if verb == "mapper" {
            command.arg("--output_path").arg(models);
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

/// Stops Qt from needing a display: COLMAP 3 starts it even without windows.
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

impl ColmapOutput {
    /// Returns the step's finished fraction if the line has one.
    pub fn hear(&mut self, line: &str, photos: usize) -> Option<f64> {
        // Strips glog's prefix.
        let text =
            line.split_once("] ").filter(|(head, _)| head.contains(".cc:")).map_or(line, |(_, text)| text).trim();
        if std::mem::take(&mut self.pairs_follow) {
            self.pairs = number(text);
        }
        if let Some(rest) = text.strip_prefix("Features:") {
            self.features.extend(number(rest));
        } else if let Some(rest) = text.strip_prefix("Loading matches...") {
            self.pairs = number(rest);
            self.pairs_follow = self.pairs.is_none();
        }
        self.no_start |= text.contains("No good initial image pair found") || text.contains("failed to create sparse");
        self.no_room |= ["disk is full", "No space left"].iter().any(|words| text.contains(words));
        let far = progress(text, photos);
        if far.is_none() && text.contains(char::is_alphanumeric) && !text.starts_with("Elapsed time") {
            self.last.push(text.to_owned());
            self.last.drain(..self.last.len().saturating_sub(LAST));
        }
        far
    }

    pub fn found_nothing(&mut self, step: Step, status: ExitStatus) -> bool {
        let no_start = std::mem::take(&mut self.no_start);
        matches!(step, Step::Cameras(_)) && no_start && status.code() == Some(1)
    }

    pub fn last_words(&self) -> String {
        self.last.join("; ")
    }
}

/// Parses a leading number.
fn number(text: &str) -> Option<usize> {
    let text = text.trim_start();
    text[..text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len())].parse().ok()
}

/// Returns the fraction in `Processed file [3/11]`, `Matching block [1/2, 2/2]`, `Registering image
/// #6 (3)` (COLMAP 3), `(num_reg_frames=3)` (COLMAP 4).
fn progress(text: &str, photos: usize) -> Option<f64> {
    if text.starts_with("Registering image") {
        let inside = text.split_once('(')?.1;
        let count = number(inside.trim_start_matches(|c: char| !c.is_ascii_digit()))?;
        return Some((count as f64 / photos as f64).min(1.0));
    }
    if !["Processed file [", "Matching ", "Processing "].iter().any(|start| text.starts_with(start)) {
        return None;
    }
    let counters = text.split_once('[')?.1.split_once(']')?.0;
    let (mut done, mut part) = (0.0, 1.0);
    let mut counters = counters.split(',').peekable();
    while let Some(counter) = counters.next() {
        let (at, of) = counter.split_once('/')?;
        let (at, of): (f64, f64) = (at.trim().parse().ok()?, of.trim().parse().ok()?);
        // Counters except the last name the unfinished item.
        let at = if counters.peek().is_some() { at - 1.0 } else { at };
        part /= of.max(1.0);
        done += at * part;
    }
    Some(done.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_read_from_words_of_both_versions() {
        for (line, far) in [
            ("Processed file [3/12]", Some(0.25)),
            ("I20261123 01:43:37.080578 140044044068544 feature_extraction.cc:270] Processed file [6/12]", Some(0.5)),
            ("Matching block [1/2, 1/2] in 1.2s", Some(0.25)),
            ("Matching block [2/2, 2/2] in 1.2s", Some(1.0)),
            ("I20261123 01:43:40.5 1 pairing.cc:214] Processing block [2/2, 1/2]", Some(0.75)),
            ("Matching image [1/4] in 0.1s", Some(0.25)),
            ("Registering image #6 (3)", Some(0.3)),
            ("I20261123 01:43:43.3 1 incremental_pipeline.cc:620] Registering image #6 (num_reg_frames=5)", Some(0.5)),
            ("  Name:            001.jpg", None),
            ("Processed file [a/b]", None),
        ] {
            assert_eq!(ColmapOutput::default().hear(line, 10), far, "{line}");
        }
    }

    #[test]
    fn pairs_and_features_are_counted() {
        let mut output = ColmapOutput::default();
        let lines = [
            "  Features:        2666",
            "I2 1 2 feature_extraction.cc:294]   Features:        31 (SIFT)",
            "Loading matches... 49 in 0.000s",
        ];
        for line in lines {
            output.hear(line, 3);
        }
        assert_eq!((&output.features[..], output.pairs), (&[2666, 31][..], Some(49)));
        output.hear("I2 1 2 database_cache.cc:144] Loading matches...", 3);
        output.hear("I2 1 2 database_cache.cc:163]  48 in 0.000s", 3);
        assert_eq!(output.pairs, Some(48));
        assert!(!output.no_start);
        output.hear("ERROR: failed to create sparse model", 3);
        assert!(
            output.no_start && output.last_words().ends_with("failed to create sparse model"),
            "{}",
            output.last_words()
        );
    }
}
