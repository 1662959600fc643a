use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};
use zipsplat::{Error, Result};

const NAMED: usize = 5;

pub fn text(path: &Path) -> Result<&str> {
    path.to_str().ok_or_else(|| {
        Error::argument("name of a photo", format!("{path:?}"), "UTF-8, as files of cameras hold it: rename the photo")
    })
}

/// Stems of file names; equal ones are numbered: `a-1`, `a-2`.
pub fn unique_stems(files: &[impl AsRef<Path>]) -> Vec<String> {
    let stem = |file: &Path| file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let stems: Vec<String> = files.iter().map(|file| stem(file.as_ref())).collect();
    let mut taken: HashSet<String> = stems.iter().cloned().collect();
    let unique = |stem: &String| match stems.iter().filter(|other| *other == stem).count() {
        1 => stem.clone(),
        _ => (1..).map(|n| format!("{stem}-{n}")).find(|name| taken.insert(name.clone())).expect("endless"),
    };
    stems.iter().map(unique).collect()
}

pub fn names(files: &[PathBuf]) -> String {
    named(files, |path| path.file_name().unwrap_or_default().to_string_lossy().into_owned())
}

pub fn named(paths: &[PathBuf], name: impl Fn(&PathBuf) -> String) -> String {
    let mut names: Vec<String> = paths.iter().take(NAMED).map(name).collect();
    if paths.len() > NAMED {
        names.push("...".into());
    }
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stems_are_unique() {
        assert_eq!(unique_stems(&["x/a.jpg", "y/a.png", "a-1.jpg", "b.jpg"]), ["a-2", "a-3", "a-1", "b"]);
    }
}
