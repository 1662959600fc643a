//! Photos from files and folders to views of the network's size.

use crate::{options::Size, session::Stage};
use rayon::prelude::*;
use std::{
    cmp::Ordering,
    path::{Path, PathBuf},
    sync::atomic::{self, AtomicUsize},
};
use zipsplat::{
    Error, Result,
    types::{
        Image,
        preprocess::{View, fit},
    },
};

/// Extensions of the files of a folder that are taken for photos.
const EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// The photos that `paths` stand for: files as they are, of folders the photos inside by natural order.
///
/// # Errors
/// Where a path does not exist or a folder has no photo.
pub fn list(paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut photos = Vec::new();
    for path in paths {
        if path.metadata().map_err(|error| Error::io(path, error))?.is_dir() {
            photos.extend(list_folder(path)?);
        } else {
            photos.push(path.clone());
        }
    }
    Ok(photos)
}

fn list_folder(folder: &Path) -> Result<Vec<PathBuf>> {
    let failed = |error| Error::io(folder, error);
    let is_photo = |path: &Path| {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str())) && path.is_file()
    };
    let mut photos = Vec::new();
    for entry in folder.read_dir().map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if is_photo(&path) {
            photos.push(path);
        }
    }
    if photos.is_empty() {
        let expected = format!("files that end in {}", EXTENSIONS.join(", "));
        return Err(Error::argument(format!("photos in {}", folder.display()), "none", expected));
    }
    photos.sort_by(|a, b| natural(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b)));
    Ok(photos)
}

/// Orders numbers in names by value: `2.png` before `10.png`.
fn natural(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let (Some(x), Some(y)) = (a.chars().next(), b.chars().next()) else { return a.len().cmp(&b.len()) };
        let number = x.is_ascii_digit() && y.is_ascii_digit();
        let split =
            |text: &str| if number { end_of_digits(text) } else { text.chars().next().map_or(0, char::len_utf8) };
        let ((head_a, rest_a), (head_b, rest_b)) = (a.split_at(split(a)), b.split_at(split(b)));
        let order = if number {
            let value = |digits: &str| digits.trim_start_matches('0').to_owned();
            let (va, vb) = (value(head_a), value(head_b));
            va.len().cmp(&vb.len()).then(va.cmp(&vb))
        } else {
            head_a.cmp(head_b)
        };
        if order.is_ne() {
            return order;
        }
        (a, b) = (rest_a, rest_b);
    }
}

fn end_of_digits(text: &str) -> usize {
    text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len())
}

/// Reads photos and brings them to `size`, several at once.
///
/// # Errors
/// The first photo's, in their order, that cannot be read.
pub fn load(photos: &[PathBuf], Size(width, height): Size, stage: &Stage<'_>) -> Result<Vec<View>> {
    let done = AtomicUsize::new(0);
    let load = |path: &PathBuf| {
        let view = fit(&Image::open(path)?, width, height)?;
        let done = 1 + done.fetch_add(1, atomic::Ordering::Relaxed);
        stage.reach(done as f64 / photos.len() as f64)?;
        Ok(view)
    };
    photos.par_iter().map(load).collect::<Vec<_>>().into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::natural;

    #[test]
    fn numbers_count_by_value() {
        let mut names = ["b1", "a10", "a2", "a02b", "a", "é1"];
        names.sort_by(|a, b| natural(a, b));
        assert_eq!(names, ["a", "a2", "a02b", "a10", "b1", "é1"]);
    }
}
