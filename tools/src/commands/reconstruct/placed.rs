use crate::{cameras::path_from, file_names::names, options::Size, outputs::make_folder, table::counted};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    cameras::CameraEstimate,
    types::{
        Camera, Image, median,
        poses::{CaptureView, write_frames_with},
        preprocess::PixelMap,
    },
};

pub struct Placed {
    pub found: Vec<Result<CameraEstimate>>,
    pub size: Size,
}

impl Placed {
    /// Returns a note on photos without a camera.
    pub fn save(&self, path: &Path, photos: &[PathBuf]) -> Result<Option<String>> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let (mut frames, mut fields, mut lost) = (Vec::new(), Vec::new(), Vec::new());
        for (photo, found) in photos.iter().zip(&self.found) {
            let Ok(CameraEstimate { camera, inliers, pairs }) = found else {
                lost.push(photo.clone());
                continue;
            };
            make_folder(folder)?;
            let (width, height) = Image::size(photo)?;
            let intrinsics = PixelMap::cropped([width, height], [self.size.0, self.size.1]).undo(&camera.intrinsics);
            let camera = Image::camera_as_stored(photo, &Camera { intrinsics, ..*camera })?;
            frames.push(CaptureView { name: path_from(folder, photo)?, photo: None, camera, lens: None });
            let counts = [("inliers", inliers), ("patches", pairs)];
            fields.push(Map::from_iter(counts.map(|(name, count)| (name.to_owned(), json!(count)))));
        }
        if let (true, Some(Err(error))) = (frames.is_empty(), self.found.first()) {
            let found = format!("none: {error}");
            return Err(Error::argument(
                path.display().to_string(),
                found,
                "a scene with which photos agree; --cameras colmap finds more",
            ));
        }
        write_frames_with(path, &frames, None, &fields)?;
        Ok((!lost.is_empty()).then(|| format!("without a camera: {}", names(&lost))))
    }

    pub fn summary(&self) -> String {
        let found: Vec<&CameraEstimate> = self.found.iter().flatten().collect();
        let shares = found.iter().map(|found| found.inliers as f64 / found.pairs as f64);
        let Some(median) = median(shares) else { return "cameras: none\n".into() };
        let of = counted(self.found.len(), "photo");
        format!("cameras of {} of {of}: {:.0} % of a photo's patches agree (median)\n", found.len(), 100.0 * median)
    }

    pub fn as_json(&self) -> Value {
        let one = |found: &Result<CameraEstimate>| match found {
            Ok(CameraEstimate { camera, inliers, pairs }) => {
                json!({ "inliers": inliers, "patches": pairs, "hfov_deg": camera.intrinsics.hfov().to_degrees() })
            }
            Err(_) => Value::Null,
        };
        self.found.iter().map(one).collect()
    }
}
