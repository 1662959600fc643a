//! Frames that a file says: `{"scene": {"context": [0, 19, ..], "target": [1, 6, ..]}}`, the reference's JSON.

use crate::stamp::digest;
use serde::Deserialize;
use std::{collections::HashMap, path::Path};
use zipsplat::{Error, Result};

/// The frames of each scene; scenes without any are left out of an evaluation.
pub struct Indices {
    scenes: HashMap<String, Option<Entry>>,
    digest: String,
}

/// The frames of one scene, by their place in its camera file. Other fields, such as the overlap, do not matter.
#[derive(Clone, Deserialize)]
pub struct Entry {
    /// The input frames.
    pub context: Vec<usize>,
    /// The frames to compare with.
    pub target: Vec<usize>,
}

impl Indices {
    /// Reads a file.
    ///
    /// # Errors
    /// [`Error::Io`] where it cannot be read; [`Error::Format`] where it is something else, or no scene has both lists, or scenes
    /// have different numbers of inputs.
    pub fn open(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|error| Error::io(path, error))?;
        let malformed = |reason: String| Error::format(path, None, reason);
        let scenes: HashMap<String, Option<Entry>> =
            serde_json::from_str(&text).map_err(|error| malformed(error.to_string()))?;
        let mut entries: Vec<(&String, &Entry)> =
            scenes.iter().filter_map(|(name, entry)| Some((name, entry.as_ref()?))).collect();
        entries.sort_by_key(|(name, _)| *name);
        let Some((first, views)) = entries.first().map(|(name, entry)| (name, entry.context.len())) else {
            return Err(malformed(
                "found no scene, expected {\"scene\": {\"context\": [..], \"target\": [..]}}".into(),
            ));
        };
        for (name, entry) in &entries {
            if entry.context.is_empty() || entry.target.is_empty() {
                let found = format!("{} of context and {} of target", entry.context.len(), entry.target.len());
                return Err(malformed(format!("{name}: found {found}, expected some of both")));
            }
            if entry.context.len() != views {
                let found = entry.context.len();
                return Err(malformed(format!("{name}: found {found} of context, expected {views} as of {first}")));
            }
        }
        Ok(Self { scenes, digest: digest(&[text])[..8].to_owned() })
    }

    /// The number of inputs of every scene.
    pub fn views(&self) -> usize {
        self.scenes.values().flatten().next().map_or(0, |entry| entry.context.len())
    }

    /// A short text for the file's content.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// The frames of a scene, where the file has any.
    pub fn of(&self, scene: &str) -> Option<&Entry> {
        self.scenes.get(scene)?.as_ref()
    }
}
