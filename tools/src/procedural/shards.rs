//! Scenes as flat binary for training, little-endian, without padding:
//!
//! - magic: 8 bytes `ZSSCENES`
//! - format: u32 1
//! - generator: u32 [`VERSION`]
//! - number of scenes: u64; 0 until the stream ends
//! - views V, height H, width W of every scene: u32 each
//!
//! then per scene:
//!
//! - seed: u64
//! - indices in [`Family::ALL`](super::Family::ALL) and [`PathKind`](super::PathKind): u32 each
//! - intrinsics: f32 `[V][4]` fx, fy, cx, cy in pixels, centers at +0.5
//! - poses: f32 `[V][3][4]` camera-to-world, OpenCV axes, row-major; the first is the identity
//! - overlap: f32 `[V][V]`, share of the first view's surfaces visible in the second
//! - colors: u8 `[V][H][W][3]` sRGB
//! - depths: f16 `[V][H][W]` z, 0 in the sky
//!
//! World: the first view's camera, any view of the path; the median distance of all points is 1.

use std::io::{ErrorKind, Result, Write};
use std::ops::{ControlFlow, Range};
use std::sync::mpsc::sync_channel;

use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;

use super::{Capture, Options, Photos, Setup, VERSION};

const MAGIC: [u8; 8] = *b"ZSSCENES";
const FORMAT: u32 = 1;
/// Per thread in a batch; the writer holds another batch.
const BATCH: u64 = 4;

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
    to.write_all(&MAGIC)?;
    to.write_all([FORMAT, VERSION].map(u32::to_le_bytes).as_flattened())?;
    to.write_all(&scenes.to_le_bytes())?;
    to.write_all([options.views as u32, options.height, options.width].map(u32::to_le_bytes).as_flattened())?;
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
