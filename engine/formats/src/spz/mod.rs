//! Niantic's SPZ, versions 2 to 4: a header and a quantized section per attribute. Versions 2 and 3
//! are a gzip stream, version 4 has a zstd frame per section (`streams`). Converts from x right, y
//! up, z backward.
//!
//! Resolution: positions 2⁻¹⁷, coarser if the scene extends beyond 128 units; scales 3.2 % from
//! e⁻¹⁰ to e⁵·⁹; opacities 1/510. Coefficients: degree 0 0.014 in ±3.33, degree 1 9/256 in ±1,
//! higher ones 17/256. Rotations: three bytes in version 2, else 0.0007 per component. Values out
//! of range are clamped; positions beyond 2²³ are errors.

mod codec;
mod gzip;
mod range;
mod streams;

use std::io::Read;

use flate2::read::GzDecoder;

use super::fault::{Fault, Parsed};
use super::format::{Encoder, Format, SaveOptions};
use super::{Scene, World, source::Source};
use crate::{Error, Result};
use codec::Layout;
use gzip::Gzip;

pub(super) const FORMAT: Format = Format {
    marks: &[&[0x1f, 0x8b], b"NGSP"],
    view_dependence: true,
    antialiased: true,
    order: None,
    read: read_unchecked,
    world: Some(read_line),
    write: encoder,
};

pub use range::spz_coarsening;

/// "NGSP". Version, count and the bytes degree, fractional bits, flags and reserved follow.
const MAGIC: u32 = 0x5053_474e;
const HEADER: usize = 16;
/// Records: after the attributes, in version 4 before them.
const HAS_EXTENSIONS: u8 = 2;
const MAX_EXTENSIONS: u64 = 1 << 20;
/// Inflated bytes per file byte, beyond real compression, against hostile files.
const MAX_INFLATION: u64 = 64;
const ALWAYS_INFLATED: u64 = 64 << 20;

fn read_line(source: Source<'_>) -> Result<Option<String>> {
    let decoder = GzDecoder::new(source);
    Ok(decoder.header().and_then(|header| header.comment()).map(|bytes| String::from_utf8_lossy(bytes).into_owned()))
}

fn encoder<'a>(scene: &'a Scene, options: &SaveOptions, world: Option<&World>) -> Result<Encoder<'a>> {
    let (version, comment) = (options.spz_version, World::line(world));
    if !matches!(version, 2..=4) {
        return Err(Error::argument("SPZ version", version, "2, 3 or 4"));
    }
    let count = u32::try_from(scene.len())
        .map_err(|_| Error::argument("scene", format!("{} Gaussians", scene.len()), "fewer than 2^32 in an SPZ"))?;
    let (fractional_bits, antialiased) = (codec::fractional_bits(scene)?, scene.antialiased);
    let layout = Layout { version, sh_degree: scene.sh_degree, fractional_bits, antialiased };
    if version == 4 {
        return Ok(Box::new(move |out| streams::write(&layout, scene, count, out)));
    }
    Ok(Box::new(move |out| {
        let mut out = Gzip::begin(out, &comment)?;
        let mut header = [MAGIC, version, count].map(u32::to_le_bytes).concat();
        header.extend(layout.fields());
        header.push(0);
        out.write(&header)?;
        layout.encode(scene, |section| out.write(&section))?;
        out.finish()
    }))
}

/// Offsets of errors refer to the inflated stream, in version 4 to the file.
fn read_unchecked(mut source: Source<'_>) -> Result<Scene> {
    let bytes = source.rest()?;
    decode(&bytes).map_err(|fault| fault.in_file(source.name))
}

impl Layout {
    /// Checks the [`fields`](Self::fields) of a header.
    fn of_header(version: u32, [sh_degree, fractional_bits, flags]: [u8; 3]) -> Parsed<Self> {
        if u32::from(sh_degree) > Scene::MAX_SH_DEGREE {
            return fault(12, format!("found degree {sh_degree}, expected 0 to {}", Scene::MAX_SH_DEGREE));
        }
        if u32::from(fractional_bits) > codec::POSITION_BITS {
            let most = codec::POSITION_BITS;
            return fault(13, format!("found {fractional_bits} fractional bits, expected 0 to {most}"));
        }
        let antialiased = flags & codec::ANTIALIASED != 0;
        Ok(Self { version, sh_degree: sh_degree.into(), fractional_bits: fractional_bits.into(), antialiased })
    }
}

fn fault<T>(offset: usize, reason: String) -> Parsed<T> {
    Err(Fault::at(offset, reason))
}

fn decode(bytes: &[u8]) -> Parsed<Scene> {
    if bytes.starts_with(&MAGIC.to_le_bytes()) {
        return streams::decode(bytes);
    }
    let mut stream = GzDecoder::new(bytes);
    let gzip = |error: std::io::Error| Fault::from(format!("gzip: {error}"));
    let mut header = [0; HEADER];
    stream.read_exact(&mut header).map_err(gzip)?;
    let word = |i: usize| u32::from_le_bytes(std::array::from_fn(|byte| header[4 * i + byte]));
    let fields = [header[12], header[13], header[14]];
    if word(0) != MAGIC {
        return fault(0, format!("found magic {:#010x}, expected {MAGIC:#010x} (\"NGSP\")", word(0)));
    }
    if !matches!(word(1), 2 | 3) {
        return fault(4, format!("found version {}, expected 2 or 3", word(1)));
    }
    let layout = Layout::of_header(word(1), fields)?;
    let expected = u64::from(word(2)) * layout.gaussian_bytes() as u64;
    // Checked before allocating by the count.
    if expected > ALWAYS_INFLATED.max(MAX_INFLATION * bytes.len() as u64) {
        let reason = format!("found {} Gaussians, which are more than {} bytes can hold", word(2), bytes.len());
        return fault(8, reason);
    }
    let mut body = Vec::new();
    stream.by_ref().take(expected).read_to_end(&mut body).map_err(gzip)?;
    if body.len() as u64 != expected {
        let reason = format!("truncated: {} Gaussians take {expected} bytes, found {}", word(2), body.len());
        return fault(HEADER + body.len(), reason);
    }
    // Reads to the end, where the checksum is.
    let (has_extensions, count) = (fields[2] & HAS_EXTENSIONS != 0, body.len());
    let most = if has_extensions { MAX_EXTENSIONS } else { 0 };
    let rest = stream.take(most + 1).read_to_end(&mut body).map_err(gzip)? as u64;
    if rest > most {
        let reason = format!("found more than {most} bytes after {} Gaussians, expected the end", word(2));
        return fault(HEADER + count, reason);
    }
    if has_extensions {
        let after = |fault: Fault| Fault { offset: fault.offset.map(|at| HEADER + at), ..fault };
        streams::check_axes(&body, count).map_err(after)?;
        body.truncate(count);
    }
    Ok(layout.decode(&body, word(2) as usize))
}
