use super::{
    Posed, Reconstruct,
    forward::{Forward, LOAD_WEIGHTS},
    refined::RefinedScene,
    world::{WorldName, coarse},
};
use crate::{
    cameras::{EstimatedCameras, Place},
    commands::render::Render,
    outputs,
    refinement::{self, save_cameras},
    session::{Session, stage_seconds},
    table::{bytes, counted, time},
    video::FrameFolder,
};
use serde_json::{Value, json};
use std::{
    fmt::Write,
    time::{Duration, Instant},
};
use zipsplat::{
    Result,
    gpu::Device,
    stages::render::Renderer,
    types::{Pose, SaveOptions, Scene},
};

pub struct Finished<'a> {
    pub posed: Posed<'a>,
    pub found: Option<EstimatedCameras>,
    pub forward: Option<Forward>,
    pub refined: Option<RefinedScene>,
    pub device: Device,
    pub scene: Scene,
    pub times: Vec<(String, Duration)>,
}

impl Reconstruct {
    pub fn save(
        &self,
        session: &mut Session<'_>,
        made: &mut Finished<'_>,
        folder: &mut Option<FrameFolder>,
    ) -> Result<()> {
        let Posed { photos, poses, frames } = made.posed;
        if let Some(first) = self.moved(made.posed) {
            made.scene.place(1.0, &first);
            session.notes(coarse(&first, made.forward.as_ref()));
        }
        // A stage would drop the scene at Ctrl-C.
        let begin = Instant::now();
        let world = self.world.of(frames);
        session.notes(outputs::save_scene(self.output(), &made.scene, &SaveOptions::default(), world.as_ref())?);
        made.times.push(("write".to_owned(), begin.elapsed()));
        let optimized = self.cameras_out.as_ref().filter(|_| self.refine.settings.optimize_cameras);
        if let (Some(path), Some(RefinedScene { refined, .. }), Some(first)) =
            (optimized, &made.refined, made.posed.first())
        {
            let points = match &made.found {
                Some(_) => Some(Place(path).points()),
                None => poses.and_then(|poses| poses.points.clone()),
            };
            save_cameras(path, refined, &first.into(), photos, frames, points.as_deref())?;
            folder.iter_mut().for_each(FrameFolder::keep);
        }
        if let Some(RefinedScene { refined, request, .. }) = &made.refined {
            refinement::conclude(session, self.output(), request, refined)?;
        }
        let found = made.forward.as_ref().and_then(|forward| forward.found.as_ref());
        if let (Some(path), Some(found)) = (&self.cameras_out, found) {
            session.notes(found.save(path, photos)?);
            folder.iter_mut().for_each(FrameFolder::keep);
        }
        Ok(())
    }

    /// First camera, if not the world.
    fn moved(&self, posed: Posed<'_>) -> Option<Pose> {
        posed.first().filter(|_| matches!(self.world, WorldName::InputCameras))
    }

    pub fn draw(
        &self,
        session: &mut Session<'_>,
        made: &mut Finished<'_>,
        drawing: &Render,
    ) -> Result<(Value, String)> {
        let begin = Instant::now();
        let mut renderer = Renderer::new(&made.device);
        // The host may have changed the scene.
        let as_made = made.refined.is_none() && self.moved(made.posed).is_none();
        let own = made.forward.as_ref().filter(|_| as_made).and_then(|forward| forward.on_device.as_ref());
        let load = |_: &mut Session<'_>, renderer: &mut Renderer| match own {
            Some(gaussians) => renderer.set_scene(gaussians),
            None => renderer.set_scene(&made.scene),
        };
        let world = self.world.of(made.posed.frames);
        let drawn = drawing.draw(session, &mut renderer, &made.scene, 0, world.as_ref(), load)?;
        made.times.push(("pictures".to_owned(), begin.elapsed()));
        Ok(drawn)
    }

    pub fn report(
        &self,
        session: &mut Session<'_>,
        mut made: Finished<'_>,
        drawn: Option<(Value, String)>,
    ) -> Result<()> {
        let total = session.began.elapsed();
        let other = total.saturating_sub(made.times.iter().map(|(_, took)| *took).sum());
        made.times.push(("other".to_owned(), other));
        let stages = stage_seconds(&made.times);
        made.times.push(("total".to_owned(), total));
        let Finished { posed: Posed { photos, .. }, forward, refined, device, scene, times, .. } = &made;
        let peaks = forward.iter().map(|forward| forward.peak_bytes);
        let peaks = peaks.chain(refined.iter().map(|made| made.refined.peak_bytes));
        let peak_bytes = peaks.fold(device.allocated_bytes(), u64::max);
        let name = &device.limits().name;
        let mut json = json!({
            "output": self.output().to_string_lossy(), "device": name, "photos": photos.len(),
            "gaussians": scene.len(), "peak_bytes": peak_bytes, "seconds": total.as_secs_f64(), "stage_seconds": stages,
        });
        let mut text = format!("{}: {}{}\n", self.output().display(), counted(scene.len(), "Gaussian"), made.origin());
        if let Some(forward) = forward {
            text += &forward.summary;
            forward.json.iter().for_each(|(name, value)| json[*name] = value.clone());
        }
        text += &format!("at most {} of {name}\n", bytes(peak_bytes));
        for (stage, took) in times {
            let loaded = forward.as_ref().filter(|_| *stage == LOAD_WEIGHTS);
            let rate = loaded.map_or_else(String::new, |forward| format!("  ({}/s)", bytes(forward.rate)));
            let _ = writeln!(text, "  {stage:<13}{:>10}{rate}", time(*took));
        }
        let explanation = forward.as_ref().and_then(|forward| forward.explanation.as_ref());
        if let Some(explanation) = explanation.filter(|_| self.explain) {
            text += &format!("\n{explanation}");
            json["explain"] = json!(explanation);
        }
        if let Some(RefinedScene { refined, started, cameras, request, .. }) = refined {
            text += &format!("{}\n", refinement::summary(refined, started, cameras));
            if self.explain {
                let table = refinement::explain(refined, request, &self.refine.settings, started, photos);
                text += &format!("\n{table}");
            }
            json["refined"] = refinement::as_json(refined, started, cameras);
        }
        if let Some((pictures, description)) = drawn {
            json["pictures"] = pictures;
            text += &description;
        }
        session.report(&json, text)
    }
}

impl Finished<'_> {
    fn origin(&self) -> String {
        match (&self.refined, &self.forward) {
            (Some(made), _) => {
                let steps = counted(made.refined.best_step, "step");
                let photos = counted(self.posed.photos.len() - made.refined.holdout_views.len(), "photo");
                format!(" from {}, refined for {steps} against {photos}", made.started)
            }
            (None, Some(forward)) => forward.views_summary.clone(),
            (None, None) => String::new(),
        }
    }
}
