//! Reads streams of scenes, as [`zipsplat_cli::procedural::shards`] documents them.

use half::f16;
use std::io::{ErrorKind, Read, Result};
use zipsplat_cli::procedural::{Family, PathKind};

const MAGIC: [u8; 8] = *b"ZSSCENES";
const FORMAT: u32 = 1;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Number of scenes; 0 until the stream ends.
    pub scenes: u64,
    pub views: u32,
    pub height: u32,
    pub width: u32,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    pub seed: u64,
    pub family: Family,
    pub path: PathKind,
    /// `[V]` fx, fy, cx, cy.
    pub intrinsics: Vec<[f32; 4]>,
    /// `[V]` rows of camera-to-world.
    pub poses: Vec<[f32; 12]>,
    /// `[V][V]`.
    pub overlap: Vec<f32>,
    /// `[V][H][W][3]`.
    pub colors: Vec<u8>,
    /// `[V][H][W]`.
    pub depths: Vec<f16>,
}

impl Header {
    pub fn scene_bytes(&self) -> usize {
        let [v, h, w] = [self.views, self.height, self.width].map(|n| n as usize);
        16 + v * (16 + 48 + 4 * v) + v * h * w * 5
    }

    /// # Errors
    /// `InvalidData` for another magic or format; those of the reader.
    pub fn read(mut from: impl Read) -> Result<Self> {
        let magic: [u8; 8] = take(&mut from)?;
        let format = u32::from_le_bytes(take(&mut from)?);
        if magic != MAGIC || format != FORMAT {
            let reason = format!("found {magic:?} format {format}, expected {MAGIC:?} format {FORMAT}");
            return Err(std::io::Error::new(ErrorKind::InvalidData, reason));
        }
        let _generator: [u8; 4] = take(&mut from)?;
        let scenes = u64::from_le_bytes(take(&mut from)?);
        let mut side = || take(&mut from).map(u32::from_le_bytes);
        Ok(Self { scenes, views: side()?, height: side()?, width: side()? })
    }
}

impl Record {
    /// # Errors
    /// `UnexpectedEof` at the end of the stream, `InvalidData` for an index out of range.
    pub fn read(header: &Header, mut from: impl Read) -> Result<Self> {
        let mut bytes = vec![0; header.scene_bytes()];
        from.read_exact(&mut bytes)?;
        let [v, pixels] = [header.views as usize, header.height as usize * header.width as usize];
        let mut rest = bytes.as_slice();
        let mut part = |len: usize| rest.split_off(..len).unwrap_or_default();
        let words = |bytes: &[u8]| bytes.chunks_exact(4).map(|b| [b[0], b[1], b[2], b[3]]).collect::<Vec<_>>();
        let floats = |bytes: &[u8]| words(bytes).into_iter().map(f32::from_le_bytes).collect::<Vec<_>>();
        let seed = take(part(8)).map(u64::from_le_bytes)?;
        let [family, path] = [part(4), part(4)].map(|b| take(b).map(u32::from_le_bytes).unwrap_or(u32::MAX) as usize);
        let unknown = || std::io::Error::new(ErrorKind::InvalidData, format!("found family {family}, path {path}"));
        Ok(Self {
            seed,
            family: *Family::ALL.get(family).ok_or_else(unknown)?,
            path: *PathKind::ALL.get(path).ok_or_else(unknown)?,
            intrinsics: floats(part(16 * v)).as_chunks().0.to_vec(),
            poses: floats(part(48 * v)).as_chunks().0.to_vec(),
            overlap: floats(part(4 * v * v)),
            colors: part(3 * v * pixels).to_vec(),
            depths: part(2 * v * pixels).chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]])).collect(),
        })
    }
}

fn take<const N: usize>(mut from: impl Read) -> Result<[u8; N]> {
    let mut bytes = [0; N];
    from.read_exact(&mut bytes)?;
    Ok(bytes)
}
