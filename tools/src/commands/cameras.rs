use crate::{
    cameras::{Finder, Finding, ModelOption, Place, Searching},
    depth::CamerasFrom,
    options::refuse,
    outputs::Overwrite,
    photos::PhotoArgs,
    session::{Session, stage_seconds},
    table::time,
    video::FrameFolder,
};
use clap::Args;
use serde_json::json;
use std::{path::PathBuf, time::Duration};
use zipsplat::Result;

/// Estimate cameras of photos with COLMAP, Depth Anything 3 or VGGT
///
/// Runs COLMAP 3 or 4, or pycolmap, on the CPU. Writes transforms.json with the lens distortion,
/// points.ply for `refine --init points`, and colmap.log. Keeps the largest group of connected
/// photos. Retries up to twice, with other seeds and looser thresholds, if that lacks more than a
/// fifth of the photos, or any of up to 12.
///
/// --method da3 and vggt handle two photos, little overlap and little texture, but are less
/// accurate where COLMAP succeeds. They need --weights and no other program. points.ply then has
/// all confident pixels, in the network's unit.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat cameras photos/ -o transforms.json
  zipsplat cameras clip.mp4 --views 24 -o clip/transforms.json
  zipsplat cameras photos/ --python ~/venv/bin/python -o transforms.json
  zipsplat cameras photos/ --method da3 --weights da3-base.safetensors -o transforms.json")]
pub struct Cameras {
    #[command(flatten)]
    input: PhotoArgs,
    /// transforms.json to write; video frames go to the folder frames next to it, or NAME.frames
    /// for NAME.json
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Largest number of photos or video frames, evenly spaced [default: all photos, 24 frames of a
    /// video]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
    views: Option<u32>,
    /// Program or network that estimates the cameras
    #[arg(long, alias = "with", value_enum, value_name = "FINDER", default_value = "colmap")]
    method: Finder,
    /// Weights of the network, as for `depth`
    #[arg(long, value_name = "NAME|PATH|seeded:NAME", required_if_eq_any([("method", "da3"), ("method", "vggt")]))]
    weights: Option<String>,
    #[command(flatten)]
    cameras: CamerasFrom,
    #[command(flatten)]
    search: Searching,
    #[command(flatten)]
    model: ModelOption,
}

impl Cameras {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let place = Place(&self.output);
        place.check(self.overwrite)?;
        self.model.check(self.overwrite)?;
        let (is_colmap, why) = (self.method == Finder::Colmap, "--method da3 or vggt");
        refuse("--weights", is_colmap && self.weights.is_some(), "COLMAP, which needs none", why)?;
        let of_network = self.cameras != CamerasFrom::default();
        refuse("--camera-source or --per-view-focal", is_colmap && of_network, "COLMAP", why)?;
        let named_in = Some((&*self.output, self.overwrite));
        let (photos, mut frames) = self.input.list(session, self.views, Some(&self.search.masks), named_in)?;
        self.model.check_names(&photos)?;
        let (search, depth_weights) = (self.search.clone(), self.weights.clone());
        let finding = Finding { search, cameras: self.cameras, depth_weights };
        let (poses, found) = self.method.find(session, &photos, &finding)?;
        place.save(&poses, &found)?;
        frames.iter_mut().for_each(FrameFolder::keep);
        self.model.save(&poses.frames, poses.points.as_deref())?;
        poses.warnings.iter().for_each(|note| session.note(note));
        let total: Duration = found.times.iter().map(|(_, took)| *took).sum();
        let json = json!({
            "output": self.output.to_string_lossy(), "photos": photos.len(), "registered": found.count, "unregistered": found.lost,
            "components": found.groups, "points": found.points, "attempts": found.mappings, "program": found.program, "seconds": total.as_secs_f64(), "stage_seconds": stage_seconds(&found.times),
        });
        let mut text = format!("{}: {}\n", self.output.display(), found.summary());
        found.times.iter().for_each(|(step, took)| text += &format!("  {step:<13}{:>10}\n", time(*took)));
        session.report(&json, text)
    }
}
