use super::Image;
use crate::{Error, Result};
use rayon::prelude::*;
use std::{
    cmp::Ordering,
    path::{Path, PathBuf},
};

/// Extensions of photos.
pub const PHOTO_EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

impl Image {
    /// Opens the photos of a folder, in natural order of their names.
    ///
    /// # Errors
    /// [`Error::Argument`] for a folder without photos.
    pub fn open_folder(path: impl AsRef<Path>) -> Result<Vec<Self>> {
        let path = path.as_ref();
        let entries = path.read_dir().and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect());
        let mut photos: Vec<PathBuf> = entries.map_err(|source| Error::io(path, source))?;
        let is_hidden = |path: &PathBuf| path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
        photos.retain(|path| is_photo(path) && !is_hidden(path));
        photos.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b)));
        if photos.is_empty() {
            let expected = format!("files that end in {}", PHOTO_EXTENSIONS.join(", "));
            return Err(Error::argument(format!("photos in {}", path.display()), "none", expected));
        }
        photos.par_iter().map(Self::open).collect::<Vec<_>>().into_iter().collect()
    }
}

/// Returns true for a photo's extension, in any case.
pub fn is_photo(path: &Path) -> bool {
    let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
    extension.is_some_and(|extension| PHOTO_EXTENSIONS.contains(&extension.as_str()))
}

/// Compares digits by value: `2.png` before `10.png`.
pub fn natural_order(a: &str, b: &str) -> Ordering {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_count_by_value() {
        let mut names = ["b1", "a10", "a2", "a02b", "a", "é1"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["a", "a2", "a02b", "a10", "b1", "é1"]);
    }

    #[test]
    fn folders_open_in_natural_order() {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, width) in [("10.png", 10), ("2.png", 2), (".hidden.png", 3)] {
            let photo = Image::new(width, 1, vec![0; 3 * width as usize]).expect("an image");
            photo.save_png(folder.path().join(name)).expect("written");
        }
        std::fs::write(folder.path().join("notes.txt"), "").expect("written");
        let widths: Vec<u32> =
            Image::open_folder(folder.path()).expect("photos").iter().map(|photo| photo.width).collect();
        assert_eq!(widths, [2, 10]);
        Image::open_folder(tempfile::tempdir().expect("a folder").path()).unwrap_err();
    }
}
