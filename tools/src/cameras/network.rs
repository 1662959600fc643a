use super::find::{EstimatedCameras, Finding, focal};
use crate::{
    depth::{POINTS, PredictorOptions, check_finds_cameras},
    options::ArithmeticOption,
    released::open_depth,
    scratch::Scratch,
    session::Session,
};
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    depth::DepthOptions,
    stages::Family,
    types::{poses::Capture, write_points},
    weights::DepthHeads,
};

impl EstimatedCameras {
    /// In the world of one of them, with points of confident pixels.
    pub(super) fn by_network(
        session: &mut Session<'_>,
        photos: &[PathBuf],
        finding: &Finding,
        family: Family,
    ) -> Result<(Capture, Self)> {
        let (of, name) = match family {
            Family::Da3 => ("Depth Anything 3", "da3-small"),
            Family::Vggt => ("VGGT", "vggt-1b"),
        };
        let expected = format!("--depth-weights NAME|FILE, weights of {of}: {name}, or a model.safetensors");
        let none = || Error::argument("cameras of a network", "no weights", &expected);
        let checkpoint = open_depth(finding.depth_weights.as_deref().ok_or_else(none)?, DepthHeads::default())?;
        let network = checkpoint.architecture();
        if network.backbone.family != family {
            return Err(Error::argument("cameras of a network", &network.name, expected));
        }
        let arithmetic = &ArithmeticOption::default();
        let (side, cameras, request) = (finding.search.matching_size, finding.cameras, DepthOptions::default());
        let masks = finding.masks();
        let options = PredictorOptions { checkpoint: &checkpoint, side, masks, cameras, arithmetic, request };
        Self::by_predictor(session, photos, options)
    }

    pub fn by_predictor(
        session: &mut Session<'_>,
        photos: &[PathBuf],
        options: PredictorOptions<'_>,
    ) -> Result<(Capture, Self)> {
        check_finds_cameras(options.checkpoint.architecture())?;
        let predicted = options.ask(session, photos, &[])?;
        let folder = Scratch::new()?;
        let (points, path) = (predicted.points(POINTS), folder.path().join("points.ply"));
        write_points(&path, &points)?;
        let poses = Capture { frames: predicted.frames()?, points: Some(path), ..Capture::default() };
        let found = Self {
            lost: predicted.lost.clone(),
            count: poses.frames.len(),
            groups: Vec::new(),
            points: points.len(),
            focal: focal(&poses.frames),
            mappings: 1,
            program: predicted.network.clone(),
            times: predicted.times.clone(),
            predicted: Some(Box::new(predicted)),
            log: None,
            _work: folder,
        };
        Ok((poses, found))
    }
}
