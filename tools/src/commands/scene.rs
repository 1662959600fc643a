//! `zipsplat scene`: procedural scenes for demos, tests and training.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use zipsplat::{Error, Result};

use crate::procedural::{Options, Photos, Setup, shards, write_folder};

/// Make procedural scenes: photos with exact depth and poses, endless and seeded.
#[derive(Clone, Debug, clap::Args)]
pub struct Scene {
    /// The scene's seed; with --shards that of the first scene.
    #[arg(long, visible_alias = "first-seed", default_value_t = 0)]
    pub seed: u64,
    /// Photos a scene.
    #[arg(long, default_value_t = 24)]
    pub views: usize,
    /// Size of the photos in pixels.
    #[arg(long, default_value = "252x252", value_parser = parse_size, value_name = "WIDTHxHEIGHT")]
    pub size: (u32, u32),
    /// Folder of square photo crops with a manifest.json; those with a permissive licence are used as surfaces.
    #[arg(long, value_name = "DIR")]
    pub textures: Option<PathBuf>,
    /// Four rays for every pixel instead of four at edges and one elsewhere.
    #[arg(long)]
    pub supersample: bool,
    /// Write images/, depth/ and transforms.json here.
    #[arg(short, long, value_name = "DIR", required_unless_present = "shards", conflicts_with = "shards")]
    pub output: Option<PathBuf>,
    /// Stream scenes as flat binary for training to a file, or to standard output with -.
    #[arg(long, value_name = "FILE|-")]
    pub shards: Option<PathBuf>,
    /// Scenes to stream; without it until the reader goes away.
    #[arg(long, requires = "shards")]
    pub scenes: Option<u64>,
}

fn parse_size(text: &str) -> std::result::Result<(u32, u32), String> {
    let sides = text.split_once('x').and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    sides.ok_or_else(|| format!("found {text:?}, expected WIDTHxHEIGHT"))
}

/// Makes the scene or the stream.
///
/// # Errors
/// [`Error::Argument`] when sizes or counts are out of range, [`Error::Io`] and [`Error::Format`] for the files.
pub fn run(args: &Scene) -> Result<()> {
    let photos = args.textures.as_deref().map_or_else(|| Ok(Photos::default()), Photos::open)?;
    let options = Options {
        views: args.views,
        width: args.size.0,
        height: args.size.1,
        supersample: args.supersample,
        random_first: args.shards.is_some(),
    };
    options.validate()?;
    let started = Instant::now();
    match (&args.shards, &args.output) {
        (Some(path), _) => stream(path, args, &options, &photos),
        (None, Some(folder)) => {
            let capture = Setup::new(args.seed, &options, &photos)?.shoot(&photos);
            let made = started.elapsed().as_secs_f64();
            write_folder(folder, &capture, photos.crops())?;
            let (family, path) = (capture.family, capture.path);
            eprintln!("{}: {} views, {family:?}, {path:?}, made in {made:.2} s", folder.display(), args.views);
            Ok(())
        }
        (None, None) => Err(Error::argument("output", "none", "a folder or --shards")),
    }
}

fn stream(path: &Path, args: &Scene, options: &Options, photos: &Photos) -> Result<()> {
    let to: Box<dyn Write + Send> = if path == Path::new("-") {
        Box::new(std::io::stdout())
    } else {
        let file = File::options().write(true).create(true).truncate(true).open(path);
        Box::new(file.map_err(|source| Error::io(path, source))?)
    };
    let end = args.scenes.map_or(u64::MAX, |scenes| args.seed.saturating_add(scenes));
    let started = Instant::now();
    let report = |scenes: u64| {
        eprint!("\r{scenes} scenes, {:.1} a second ", scenes as f64 / started.elapsed().as_secs_f64());
    };
    let written = shards::write(BufWriter::with_capacity(1 << 20, to), args.seed..end, options, photos, report);
    eprintln!();
    match written {
        // A reader that has enough closes its end.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.map_err(|source| Error::io(path, source)),
    }
}
