//! Camera estimation by Depth Anything 3.

use super::find::{Finding, Found, focal};
use crate::{
    depth::{POINTS, Question, check_finds_cameras},
    options::ArithmeticOption,
    released::open_depth,
    scratch::Scratch,
    session::Session,
};
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    depth::DepthRequest,
    types::{poses::Poses, write_points},
};

impl Found {
    /// In the world of one of them, with points of confident pixels.
    pub(super) fn by_network(
        session: &mut Session<'_>,
        photos: &[PathBuf],
        finding: &Finding,
    ) -> Result<(Poses, Self)> {
        let expected = "--depth-weights NAME|FILE, weights of Depth Anything 3: da3-small, or a model.safetensors";
        let none = || Error::argument("cameras of a network", "no weights", expected);
        let checkpoint = open_depth(finding.depth_weights.as_deref().ok_or_else(none)?, false)?;
        let arithmetic = &ArithmeticOption::default();
        let (side, cameras, request) = (finding.search.find_size, finding.cameras, DepthRequest::default());
        let question = Question { checkpoint: &checkpoint, side, cameras, arithmetic, request };
        Self::by_question(session, photos, question)
    }

    pub fn by_question(session: &mut Session<'_>, photos: &[PathBuf], question: Question<'_>) -> Result<(Poses, Self)> {
        check_finds_cameras(question.checkpoint.architecture())?;
        let seen = question.ask(session, photos, &[])?;
        let folder = Scratch::new()?;
        let (points, path) = (seen.points(POINTS), folder.path().join("points.ply"));
        write_points(&path, &points)?;
        let poses = Poses { frames: seen.frames()?, points: Some(path), ..Poses::default() };
        let found = Self {
            lost: seen.lost.clone(),
            count: poses.frames.len(),
            groups: Vec::new(),
            points: points.len(),
            focal: focal(&poses.frames),
            mappings: 1,
            program: seen.network.clone(),
            times: seen.times.clone(),
            seen: Some(Box::new(seen)),
            log: None,
            _work: folder,
        };
        Ok((poses, found))
    }
}
