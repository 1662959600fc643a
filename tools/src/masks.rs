use clap::Args;
use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};
use zipsplat::types::{MaskSource, Masks};

const ALPHA: &str = "alpha";

#[derive(Args, Clone, Debug, Default)]
pub struct MaskArgs {
    /// Masks of the photos: COLMAP, scenes, refinement and scores ignore pixels of 0. A folder of
    /// PNGs of the photos' sizes and names (1.png or 1.jpg.png for 1.jpg), below each capture with
    /// --each; alpha: the photos' alpha channels
    #[arg(long, value_name = "DIR|alpha")]
    masks: Option<PathBuf>,
    /// Ignore the pixels that are not 0, instead
    #[arg(long, requires = "masks")]
    invert_masks: bool,
    /// Masks of photos that were cut.
    #[arg(skip)]
    cut: OnceLock<Masks>,
}

impl MaskArgs {
    /// Returns the masks of photos in this folder, if given. A folder of masks named `alpha` is
    /// `./alpha`.
    pub fn below(&self, folder: &Path) -> Option<Masks> {
        let source = |masks: &PathBuf| match masks {
            masks if masks == Path::new(ALPHA) => MaskSource::Alpha,
            masks => MaskSource::Folder(folder.join(masks)),
        };
        self.masks.as_ref().map(|masks| Masks { source: source(masks), inverted: self.invert_masks })
    }

    pub fn given(&self) -> Option<Masks> {
        self.cut.get().cloned().or_else(|| self.below(Path::new("")))
    }

    pub fn replace(&self, masks: Masks) {
        // Photos are listed once.
        let _ = self.cut.set(masks);
    }
}
