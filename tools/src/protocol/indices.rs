//! Frames in the reference's JSON: `{"scene": {"context": [0, 19, ..], "target": [1, 6, ..]}}`.

use crate::stamp::digest;
use serde::Deserialize;
use std::{collections::HashMap, path::Path};
use zipsplat::{Error, Result};

/// Unlisted scenes are skipped.
pub struct Indices {
    scenes: HashMap<String, Option<Entry>>,
    pub digest: String,
}

/// Indices into a scene's camera file.
#[derive(Clone, Deserialize)]
pub struct Entry {
    pub context: Vec<usize>,
    pub target: Vec<usize>,
}

impl Indices {
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

    pub fn views(&self) -> usize {
        self.scenes.values().flatten().next().map_or(0, |entry| entry.context.len())
    }

    pub fn of(&self, scene: &str) -> Option<&Entry> {
        self.scenes.get(scene)?.as_ref()
    }
}
