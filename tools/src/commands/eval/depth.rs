use crate::{
    capture::{Choice, ViewSplit},
    known_depth,
    views::Views,
};
use std::path::Path;
use zipsplat::{Error, Result, depth::add_view, types::Scene};

/// Returns a scene at the network's size, in the capture's world and unit.
pub fn scene(folder: &Path, choice: &Choice, capture: &ViewSplit) -> Result<Scene> {
    let mut scene = Scene { sh_degree: 0, ..Scene::default() };
    let Views { cameras, images, .. } = &capture.views;
    let depths = known_depth::read(folder, &choice.input_frames(), cameras, capture.scene_scale.length)?;
    for ((camera, image), depth) in cameras.iter().zip(images).zip(&depths) {
        add_view(&mut scene, camera, image, depth);
    }
    if scene.is_empty() {
        return Err(Error::argument("--from-depth", "no depth above 0", "depth of what the photos show"));
    }
    Ok(scene)
}
