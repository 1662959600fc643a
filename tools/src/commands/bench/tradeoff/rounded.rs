use super::Tradeoff;
use crate::{scratch::Scratch, session::Session};
use zipsplat::{
    Error, Result,
    weights::{Checkpoint, Dtype},
};

pub struct Rounded {
    pub dtype: &'static str,
    pub checkpoint: Checkpoint,
    /// Holds the checkpoint's file.
    _folder: Scratch,
}

pub const OWN: &str = "own";

/// `None` for weights as stored.
pub fn parse(text: &str) -> Result<Option<Dtype>> {
    let expected = || Error::argument("--dtype", text, format!("{OWN}, f16, bf16 or q8, as a list"));
    if text == OWN { Ok(None) } else { text.parse().map(Some).map_err(|_| expected()) }
}

pub fn all(args: &Tradeoff, session: &Session<'_>, checkpoint: &Checkpoint) -> Result<Vec<Rounded>> {
    let mut dtypes: Vec<Dtype> = args.dtype.iter().flatten().copied().collect();
    dtypes.dedup();
    let has = |dtype: &Dtype| match dtype {
        Dtype::Q8 => checkpoint.q8_names().next().is_some(),
        dtype => checkpoint.stored().keys().all(|stored| *stored == dtype.name()),
    };
    dtypes.retain(|dtype| !has(dtype));
    let round = |dtype: Dtype| {
        let folder = Scratch::new()?;
        let path = folder.path().join("weights.safetensors");
        let rounded = session.stage("round weights", |stage| {
            checkpoint.save_with(&path, dtype, |done| stage.at(done))?;
            Checkpoint::open(&path, None)
        })?;
        Ok(Rounded { dtype: dtype.name(), checkpoint: rounded.0, _folder: folder })
    };
    dtypes.into_iter().map(round).collect()
}
