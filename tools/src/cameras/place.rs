use super::EstimatedCameras;
use crate::{
    file_names::text,
    outputs::{Overwrite, check_folder, make_folder},
};
use clap::Args;
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    types::{
        PointCloud,
        poses::{Capture, CaptureView, check_colmap_name, colmap_files, read_cloud, write_colmap, write_frames},
        write_atomic, write_points,
    },
};

/// `transforms.json`, with points and any COLMAP log in its folder.
pub struct Place<'a>(pub &'a Path);

impl Place<'_> {
    /// `points.ply` for `transforms.json`, `garden.points.ply` for `garden.json`.
    pub fn beside(&self, name: &str) -> PathBuf {
        match self.0.file_stem() {
            Some(stem) if stem != "transforms" => {
                let mut own = stem.to_owned();
                own.push(format!(".{name}"));
                self.0.with_file_name(own)
            }
            _ => self.0.with_file_name(name),
        }
    }

    pub fn points(&self) -> PathBuf {
        self.beside("points.ply")
    }

    fn files(&self) -> [PathBuf; 3] {
        [self.0.to_owned(), self.points(), self.beside("colmap.log")]
    }

    pub fn check(&self, overwrite: Overwrite) -> Result<()> {
        self.check_alone(overwrite)?;
        let existing = self.files().into_iter().filter(|file| file.exists());
        existing.into_iter().try_for_each(|file| overwrite.check_file(&file))
    }

    pub fn check_alone(&self, overwrite: Overwrite) -> Result<()> {
        if self.0.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("json")) {
            return Err(Error::argument("file of cameras", self.0.display(), "one that ends in .json"));
        }
        match self.0.parent().filter(|folder| !folder.as_os_str().is_empty() && !folder.exists()) {
            Some(missing) => check_folder(missing),
            None => overwrite.check_file(self.0),
        }
    }

    /// Keeps the lenses of the unchanged photos.
    pub fn save(&self, poses: &Capture, found: &EstimatedCameras) -> Result<()> {
        let [cameras, points, log] = self.files();
        self.0.parent().map_or(Ok(()), make_folder)?;
        if let Some(cloud) = poses.points.as_ref().map(read_cloud).transpose()? {
            write_points(&points, &colored(cloud))?;
        }
        if let Some(log_text) = &found.log {
            let path = log_text.0.path();
            let log_text = std::fs::read(path).map_err(|source| Error::io(path, source))?;
            write_atomic(&log, |out| out.write_all(&log_text))?;
        }
        let folder = cameras.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let name = |frame: &CaptureView| {
            let photo = frame.photo.as_deref().unwrap_or(Path::new(&frame.name));
            Ok(CaptureView { name: path_from(folder, photo)?, ..frame.clone() })
        };
        let frames = poses.frames.iter().map(name).collect::<Result<Vec<CaptureView>>>()?;
        let points = points.file_name().unwrap_or_default().to_string_lossy();
        write_frames(&cameras, &frames, Some(&points))
    }
}

fn colored(cloud: PointCloud) -> Vec<([f32; 3], [u8; 3])> {
    cloud.positions.into_iter().zip(cloud.colors).collect()
}

#[derive(Args)]
pub struct ModelOption {
    /// Also write cameras and points to this folder as a COLMAP text model (cameras.txt,
    /// images.txt, points3D.txt), with photo names relative to their common folder
    #[arg(long, value_name = "FOLDER")]
    colmap_model: Option<PathBuf>,
}

impl ModelOption {
    pub fn check(&self, overwrite: Overwrite) -> Result<()> {
        let Some(folder) = &self.colmap_model else { return Ok(()) };
        check_folder(folder)?;
        overwrite.check_replaced(colmap_files(folder))
    }

    pub fn check_names(&self, photos: &[PathBuf]) -> Result<()> {
        let check = |_| names(photos)?.iter().try_for_each(|name| check_colmap_name(name));
        self.colmap_model.as_ref().map_or(Ok(()), check)
    }

    pub fn save(&self, frames: &[CaptureView], points: Option<&Path>) -> Result<()> {
        let Some(folder) = &self.colmap_model else { return Ok(()) };
        let photos = frames.iter().map(|frame| frame.photo.as_deref().unwrap_or(Path::new(&frame.name)));
        let photos: Vec<&Path> = photos.collect();
        let named = names(&photos)?.into_iter().zip(frames).map(|(name, frame)| CaptureView { name, ..frame.clone() });
        let named: Vec<CaptureView> = named.collect();
        make_folder(folder)?;
        write_colmap(folder, &named, &points.map(read_cloud).transpose()?.map(colored).unwrap_or_default())
    }
}

/// Paths below the photos' common folder.
fn names(photos: &[impl AsRef<Path>]) -> Result<Vec<String>> {
    let photos = photos.iter().map(AsRef::as_ref);
    let shared = photos.clone().filter_map(Path::parent).map(Path::to_owned).reduce(|a, b| {
        let common = a.components().zip(b.components()).take_while(|(a, b)| a == b);
        common.map(|(folder, _)| folder).collect()
    });
    let shared = shared.unwrap_or_default();
    photos.map(|photo| Ok(text(photo.strip_prefix(&shared).unwrap_or(photo))?.replace('\\', "/"))).collect()
}

pub fn path_from(folder: &Path, photo: &Path) -> Result<String> {
    let whole = |path: &Path| path.canonicalize().map_err(|source| Error::io(path, source));
    // The photo's name, not a link's target.
    let beside = photo.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let (folder, photo) = (whole(folder)?, whole(beside)?.join(photo.file_name().unwrap_or_default()));
    let path = photo.strip_prefix(folder).unwrap_or(&photo);
    Ok(text(path)?.replace('\\', "/"))
}
