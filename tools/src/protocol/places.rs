use super::Protocol;
use crate::stamp::entries;
use std::{
    fs::File,
    io::Read,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    types::{Distortion, poses::Capture},
};

#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// Name, as in index files.
    pub name: String,
    /// File or folder.
    cameras: PathBuf,
    /// Candidate folders, best first; if empty, the camera file names the photos.
    photos: Vec<PathBuf>,
}

impl Protocol {
    /// Folders are scenes or contain scenes. `images` overrides a scene's photo folder.
    pub fn places(self, folders: &[PathBuf], images: Option<&Path>) -> Result<Vec<Place>> {
        let mut places: Vec<Place> = Vec::new();
        for folder in folders {
            let mut found: Vec<Place> = self.at(folder, images)?.into_iter().collect();
            if found.is_empty() && folder.is_dir() {
                for entry in entries(folder)? {
                    found.extend(self.at(&entry, images)?);
                }
            }
            if found.is_empty() {
                let expected = format!("{}, or a folder of such", self.layout());
                return Err(Error::argument(format!("scene of {}", self.title()), folder.display(), expected));
            }
            places.extend(found);
        }
        places.sort_by(|a, b| a.name.cmp(&b.name));
        if let Some([a, b]) = places.windows(2).find(|pair| pair[0].name == pair[1].name) {
            let found = format!("{} and {}", a.cameras.display(), b.cameras.display());
            return Err(Error::argument(format!("scene {}", a.name), found, "one of this name"));
        }
        Ok(places)
    }

    fn layout(self) -> &'static str {
        match self {
            Self::Dl3dv => "a folder with a transforms.json, directly or in nerfstudio/",
            Self::Re10k => "a camera file NAME.txt that begins with an address",
            Self::Mipnerf360 => "a folder with a COLMAP model in sparse/0",
            Self::Scannetpp => "a folder with a COLMAP model in dslr/colmap",
        }
    }

    fn at(self, path: &Path, images: Option<&Path>) -> Result<Option<Place>> {
        // Folders to look in, cameras there, and folders of photos there, best first.
        let (bases, cameras, usual): (&[&str], &str, &[&str]) = match self {
            Self::Dl3dv => (&["", "nerfstudio"], "transforms.json", &["images_4", "images_2", "images_8", "images"]),
            Self::Re10k => (&[], "", &[]),
            Self::Mipnerf360 => (&[""], "sparse/0", &["images_4", "images"]),
            Self::Scannetpp => (&["dslr", ""], "colmap", &["resized_images", "images"]),
        };
        let model =
            |folder: &Path| ["bin", "txt"].iter().any(|end| folder.join("cameras").with_extension(end).is_file());
        let mut places = bases.iter().map(|base| (path.join(base), path.join(base).join(cameras)));
        let found = match self {
            Self::Re10k => is_addressed(path).then(|| (path.with_extension(""), path.to_owned())),
            Self::Dl3dv => places.find(|(_, cameras)| cameras.is_file()),
            Self::Mipnerf360 | Self::Scannetpp => places.find(|(_, cameras)| model(cameras)),
        };
        let Some((base, cameras)) = found else { return Ok(None) };
        let whole = path.canonicalize().map_err(|error| Error::io(path, error))?;
        let name = if whole.is_dir() { whole.file_name() } else { whole.file_stem() };
        let photos = match images {
            Some(images) => vec![base.join(images)],
            None => usual.iter().map(|folder| base.join(folder)).collect(),
        };
        Ok(Some(Place { name: name.unwrap_or_default().to_string_lossy().into_owned(), cameras, photos }))
    }
}

impl Place {
    pub fn read(&self, distorted: bool) -> Result<Capture> {
        let mut poses = Capture::open(&self.cameras)?;
        for frame in &mut poses.frames {
            let name = Path::new(&frame.name).file_name().unwrap_or_default();
            let found = self.photos.iter().map(|folder| folder.join(name)).find(|photo| photo.is_file());
            frame.photo = found.or(frame.photo.take());
            match frame.lens.filter(|_| distorted) {
                Some(lens) if !matches!(lens.distortion, Distortion::Perspective { .. }) || lens.view_count() > 1 => {
                    let found = format!("the wide lens of {}", frame.name);
                    return Err(Error::argument("--keep-distortion", found, "lenses that are almost pinholes"));
                }
                Some(lens) => (frame.camera.intrinsics, frame.lens) = (lens.intrinsics, None),
                None => {}
            }
        }
        Ok(poses)
    }
}

/// Detects an address in the first line, as in RealEstate10K.
fn is_addressed(path: &Path) -> bool {
    let mut start = [0; 4];
    path.extension().is_some_and(|extension| extension == "txt")
        && File::open(path).and_then(|mut file| file.read_exact(&mut start)).is_ok_and(|()| start == *b"http")
}
