use crate::{
    capture::{Choice, ViewSplit},
    known_depth,
};
use std::path::Path;
use zipsplat::{Error, Result, depth::add_view, types::Scene};

/// Returns a scene at the network's size, in the capture's world and unit.
pub fn scene(folder: &Path, choice: &Choice, capture: &ViewSplit) -> Result<Scene> {
    let mut scene = Scene { sh_degree: 0, ..Scene::default() };
    let views = capture.views.cameras.iter().zip(&capture.views.images);
    for (frame, (camera, image)) in choice.input_frames().into_iter().zip(views) {
        let depth = known_depth::read(folder, frame, camera, capture.scene_scale.length)?;
        add_view(&mut scene, camera, image, &depth);
    }
    if scene.is_empty() {
        return Err(Error::argument("--from-depth", "no depth above 0", "depth of what the photos show"));
    }
    Ok(scene)
}
