use super::{Encoder, failed, side};
use crate::{outputs::MADE_BY, session::Stage};
use gif::{Frame, Repeat};
use rayon::prelude::*;
use std::{
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    types::{Image, Unfinished},
};

/// For NeuQuant's palette.
const SAMPLES: u64 = 1 << 16;

pub struct Gif {
    path: PathBuf,
    file: Unfinished,
    encoder: gif::Encoder<BufWriter<File>>,
    fps: u16,
    pushed: u64,
}

impl Gif {
    pub fn begin(path: &Path, (width, height): (u32, u32), fps: u16) -> Result<Self> {
        let (width, height) = (side(width, "GIF")?, side(height, "GIF")?);
        let fail = |error: gif::EncodingError| failed(path)(error.into());
        let file = Unfinished::begin(path)?;
        let mut encoder = gif::Encoder::new(file.writer()?, width, height, &[]).map_err(fail)?;
        encoder.set_repeat(Repeat::Infinite).map_err(fail)?;
        let comment = gif::AnyExtension::from(gif::Extension::Comment);
        encoder.write_raw_extension(comment, &[MADE_BY.as_bytes()]).map_err(fail)?;
        Ok(Self { path: path.into(), file, encoder, fps, pushed: 0 })
    }
}

impl Encoder for Gif {
    fn push(&mut self, images: &[Image]) -> Result<()> {
        let (fps, pushed) = (u64::from(self.fps), self.pushed);
        // Rounded due times do not accumulate errors.
        let due = |i: u64| (100 * i + fps / 2) / fps;
        let encode = |(i, image): (usize, &Image)| {
            let (width, height) = (side(image.width, "GIF")?, side(image.height, "GIF")?);
            let mut frame = Frame::from_rgb_speed(width, height, &image.rgb, speed(image));
            let i = pushed + i as u64;
            frame.delay = (due(i + 1) - due(i)) as u16;
            frame.make_lzw_pre_encoded();
            Ok(frame)
        };
        for frame in images.par_iter().enumerate().map(encode).collect::<Vec<Result<Frame>>>() {
            self.encoder.write_lzw_pre_encoded_frame(&frame?).map_err(|error| failed(&self.path)(error.into()))?;
            self.pushed += 1;
        }
        Ok(())
    }

    fn finish(self: Box<Self>, _: &Stage<'_>) -> Result<()> {
        let Self { path, file, encoder, .. } = *self;
        let out = encoder.into_inner().map_err(|error| failed(&path)(error.into()))?;
        out.into_inner().map_err(|error| Error::io(&path, error.into_error()))?;
        file.finish()
    }
}

/// NeuQuant's sampling step, from 1 to 30.
fn speed(image: &Image) -> i32 {
    let pixels = u64::from(image.width) * u64::from(image.height);
    (pixels / SAMPLES).clamp(1, 30) as i32
}
