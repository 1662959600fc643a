//! Scenes as flat binary for training, little-endian, without padding:
//!
//! - magic: 8 bytes `ZSSCENES`
//! - format: u32 1
//! - generator: u32 [`VERSION`]
//! - number of scenes: u64; 0 until the stream ends
//! - views V, height H, width W of every scene: u32 each
//!
//! then [`Header::scene_bytes`] bytes per scene:
//!
//! - seed: u64
//! - indices in [`Family::ALL`] and [`PathKind`]: u32 each
//! - intrinsics: f32 `[V][4]` fx, fy, cx, cy in pixels, centers at +0.5
//! - poses: f32 `[V][3][4]` camera-to-world, OpenCV axes, row-major; the first is the identity
//! - overlap: f32 `[V][V]`, share of the first view's surfaces visible in the second
//! - colors: u8 `[V][H][W][3]` sRGB
//! - depths: f16 `[V][H][W]` z, 0 in the sky
//!
//! World: the first view's camera, any view of the path; the median distance of all points is 1.

use std::io::{ErrorKind, Read, Result, Write};
use std::ops::{ControlFlow, Range};
use std::sync::mpsc::sync_channel;

use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;

use super::{Capture, Family, Options, PathKind, Photos, Setup, VERSION};

const MAGIC: [u8; 8] = *b"ZSSCENES";
const FORMAT: u32 = 1;
/// Per thread in a batch; the writer holds another batch.
const BATCH: u64 = 4;

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

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = MAGIC.to_vec();
        bytes.extend([FORMAT, VERSION].map(u32::to_le_bytes).as_flattened());
        bytes.extend(self.scenes.to_le_bytes());
        bytes.extend([self.views, self.height, self.width].map(u32::to_le_bytes).as_flattened());
        bytes
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

/// Writes the scenes of `seeds` in order. A range to `u64::MAX` is endless. `written` gets the
/// number of scenes after each batch and may stop the stream.
pub fn write(
    mut to: impl Write,
    seeds: Range<u64>,
    options: &Options,
    photos: &Photos,
    mut written: impl FnMut(u64) -> ControlFlow<()>,
) -> Result<()> {
    options.validate().map_err(std::io::Error::other)?;
    let scenes = if seeds.end == u64::MAX { 0 } else { seeds.end - seeds.start };
    let header = Header { scenes, views: options.views as u32, height: options.height, width: options.width };
    to.write_all(&header.bytes())?;
    let make =
        |seed| Setup::new(seed, options, photos, &|| Ok(()))?.shoot(photos, &|| Ok(())).map(|capture| encode(&capture));
    let (sender, receiver) = sync_channel::<zipsplat::Result<Vec<Vec<u8>>>>(1);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            let (mut next, batch) = (seeds.start, BATCH * rayon::current_num_threads() as u64);
            while next < seeds.end {
                let end = seeds.end.min(next.saturating_add(batch));
                let batch = (next..end).into_par_iter().map(make).collect();
                if sender.send(batch).is_err() {
                    break;
                }
                next = end;
            }
        });
        let mut done = 0;
        // Owned here, so that an early return stops the other thread.
        for batch in receiver {
            for scene in batch.map_err(std::io::Error::other)? {
                to.write_all(&scene)?;
                done += 1;
            }
            if written(done).is_break() {
                return Err(ErrorKind::Interrupted.into());
            }
        }
        to.flush()
    })
}

fn encode(capture: &Capture) -> Vec<u8> {
    let mut bytes = capture.seed.to_le_bytes().to_vec();
    bytes.extend((capture.family as u32).to_le_bytes());
    bytes.extend((capture.path as u32).to_le_bytes());
    let mut floats: Vec<f32> = Vec::new();
    for camera in &capture.cameras {
        let i = &camera.intrinsics;
        floats.extend([i.fx, i.fy, i.cx, i.cy].map(|value| value as f32));
    }
    for camera in &capture.cameras {
        let (r, t) = (camera.pose.rotation, camera.pose.translation);
        let row = |i: usize| [r.x_axis[i], r.y_axis[i], r.z_axis[i], t[i]].map(|value| value as f32);
        floats.extend([row(0), row(1), row(2)].as_flattened());
    }
    floats.extend(&capture.overlap);
    bytes.extend(floats.iter().flat_map(|value| value.to_le_bytes()));
    for image in &capture.images {
        bytes.extend(&image.rgb);
    }
    for depth in &capture.depths {
        let mut halves = vec![f16::ZERO; depth.len()];
        halves.convert_from_f32_slice(depth);
        bytes.extend(halves.iter().flat_map(|value| value.to_le_bytes()));
    }
    bytes
}
