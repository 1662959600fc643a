use super::{Encoder, failed};
use crate::{outputs::MADE_BY, session::Stage};
use png::{BitDepth, ColorType, EncodingError, Writer};
use std::{
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};
use zipsplat::{
    Result,
    types::{Image, Unfinished},
};

pub struct Apng {
    path: PathBuf,
    file: Unfinished,
    writer: Writer<BufWriter<File>>,
}

impl Apng {
    pub fn begin(path: &Path, (width, height): (u32, u32), fps: u16, frames: usize) -> Result<Self> {
        let file = Unfinished::begin(path)?;
        let mut encoder = png::Encoder::new(file.writer()?, width, height);
        encoder.set_color(ColorType::Rgb);
        encoder.set_depth(BitDepth::Eight);
        let header = || {
            // 0 plays loop forever.
            encoder.set_animated(frames as u32, 0)?;
            encoder.set_frame_delay(1, fps)?;
            encoder.add_text_chunk("Software".into(), MADE_BY.into())?;
            encoder.write_header()
        };
        let writer = header().map_err(|error: EncodingError| failed(path)(error.into()))?;
        Ok(Self { path: path.into(), file, writer })
    }
}

impl Encoder for Apng {
    fn push(&mut self, images: &[Image]) -> Result<()> {
        for image in images {
            self.writer.write_image_data(&image.rgb).map_err(|error| failed(&self.path)(error.into()))?;
        }
        Ok(())
    }

    fn finish(self: Box<Self>, _: &Stage<'_>) -> Result<()> {
        let Self { path, file, writer } = *self;
        writer.finish().map_err(|error| failed(&path)(error.into()))?;
        file.finish()
    }
}
