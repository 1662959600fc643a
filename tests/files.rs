use flate2::{Compression, read::GzDecoder, write::GzEncoder};
use image::{DynamicImage, ImageFormat};
use std::io::{Cursor, Read, Write};
use std::path::Path;
use zipsplat::Error;

#[track_caller]
pub fn assert_refused<T>(found: Result<T, Error>, words: &[&str]) -> Error {
    let Err(error) = found else { panic!("no error, expected {words:?}") };
    let text = error.to_string();
    for word in words {
        assert!(text.contains(word), "{text}\nlacks {word}");
    }
    error
}

/// Rejected as a malformed file of this name, with each of these words.
#[track_caller]
pub fn assert_malformed<T>(
    name: &str,
    bytes: impl AsRef<[u8]>,
    read: impl FnOnce(&Path) -> Result<T, Error>,
    words: &[&str],
) {
    let error = assert_refused(read_as(name, bytes, read), words);
    assert!(matches!(&error, Error::Format { path, .. } if path.ends_with(name)), "{error}");
}

pub fn read_as<T>(name: &str, bytes: impl AsRef<[u8]>, read: impl FnOnce(&Path) -> T) -> T {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    read(&path)
}

pub fn bytes_of(name: &str, write: impl FnOnce(&Path)) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    write(&path);
    std::fs::read(path).unwrap()
}

pub fn gzip(bytes: &[u8], level: Compression) -> Vec<u8> {
    let mut out = GzEncoder::new(Vec::new(), level);
    out.write_all(bytes).unwrap();
    out.finish().unwrap()
}

pub fn gunzip(bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    GzDecoder::new(bytes).read_to_end(&mut out).unwrap();
    out
}

pub fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}
