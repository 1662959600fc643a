//! SPZ version 4: header, extension records, table of stream sizes, a zstd frame per section.

use std::io::{Read, Write};

use rayon::prelude::*;
use ruzstd::decoding::StreamingDecoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::{HAS_EXTENSIONS, Layout, MAGIC, Parsed, fault};
use crate::Scene;

const VERSION: u32 = 4;
/// Bytes per file byte, as in deflate.
const MAX_INFLATION: u64 = 1032;
const HEADER: usize = 32;
const ENTRY: usize = 16;
/// Minimum that the zstd specification recommends.
const MIN_WINDOW: u64 = 8 << 20;
const COORDINATE_SYSTEM: u32 = 0xadbe_0003;
const RIGHT_UP_BACK: u32 = 4;

pub(super) fn decode(bytes: &[u8]) -> Parsed<Scene> {
    if bytes.len() < HEADER {
        return fault(bytes.len(), format!("truncated: found {} bytes, expected a header of {HEADER}", bytes.len()));
    }
    let (version, count, fields) = (word(bytes, 4), word(bytes, 8), [bytes[12], bytes[13], bytes[14]]);
    if version != VERSION {
        return fault(4, format!("found version {version} outside a gzip stream, expected {VERSION}"));
    }
    let layout = Layout::of_header(version, fields)?;
    // zstd could expand any number from a few bytes.
    if u64::from(count) * layout.gaussian_bytes() as u64 > MAX_INFLATION * bytes.len() as u64 {
        return fault(8, format!("found {count} Gaussians in {} bytes, which cannot hold as many", bytes.len()));
    }
    let table = word(bytes, 16) as usize;
    if table < HEADER || table > bytes.len() {
        return fault(16, format!("found the table of streams at byte {table}, expected {HEADER} to {}", bytes.len()));
    }
    if fields[2] & HAS_EXTENSIONS != 0 {
        check_axes(&bytes[..table], HEADER)?;
    }
    let sections: Vec<usize> = layout.section_bytes().map(|section| section * count as usize).to_vec();
    let streams = streams(bytes, table, &sections)?;
    let mut body = vec![0; sections.iter().sum()];
    let mut parts = Vec::new();
    let mut rest = &mut body[..];
    for stream in &streams {
        let (part, after) = rest.split_at_mut(stream.plain);
        parts.push((stream, part));
        rest = after;
    }
    parts.into_par_iter().try_for_each(|(stream, part)| {
        let packed = &bytes[stream.offset..][..stream.packed];
        inflate(packed, part)
            .or_else(|reason| fault(stream.offset, format!("stream {} of {}: {reason}", stream.number, streams.len())))
    })?;
    Ok(layout.decode(&body, count as usize))
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|byte| bytes[at + byte]))
}

/// Skips extension records, but rejects unusual axes.
pub(super) fn check_axes(zone: &[u8], mut at: usize) -> Parsed<()> {
    while at < zone.len() {
        let length = if zone.len() - at < 8 { None } else { Some(word(zone, at + 4) as usize) };
        let Some(record) = length.and_then(|length| zone[at + 8..].get(..length)) else {
            let found = zone.len() - at;
            return fault(at, format!("found {found} bytes of an extension, expected a whole record"));
        };
        if word(zone, at) == COORDINATE_SYSTEM {
            let axes = record.first_chunk().map(|axes| u32::from_le_bytes(*axes));
            if !matches!(axes, Some(0 | RIGHT_UP_BACK)) {
                let found = axes.map_or("no number".into(), |axes| format!("number {axes}"));
                return fault(at + 8, format!("found axes of {found}, expected {RIGHT_UP_BACK} (right, up, back)"));
            }
        }
        at += 8 + record.len();
    }
    Ok(())
}

struct Stream {
    number: usize,
    offset: usize,
    packed: usize,
    plain: usize,
}

fn streams(bytes: &[u8], table: usize, sections: &[usize]) -> Parsed<Vec<Stream>> {
    let expected: Vec<usize> = sections.iter().copied().filter(|bytes| *bytes > 0).collect();
    let listed = usize::from(bytes[15]);
    let mut offset = table + ENTRY * listed;
    let Some(entries) = bytes.get(table..offset) else {
        return fault(table, format!("truncated: the table of {listed} streams ends after {} bytes", bytes.len()));
    };
    let mut streams = Vec::new();
    for (i, entry) in entries.as_chunks::<ENTRY>().0.iter().enumerate() {
        let at = table + ENTRY * i;
        let size = |half: usize| u64::from_le_bytes(std::array::from_fn(|byte| entry[8 * half + byte]));
        let packed = usize::try_from(size(0)).ok().filter(|packed| *packed <= bytes.len() - offset);
        let Some(packed) = packed else {
            let left = bytes.len() - offset;
            return fault(at, format!("truncated: stream {} has {} bytes, found {left}", i + 1, size(0)));
        };
        if size(1) > 0 {
            let wanted = expected.get(streams.len()).copied().unwrap_or(0);
            if size(1) != wanted as u64 {
                let reason = format!("stream {} holds {} bytes, expected {wanted}", i + 1, size(1));
                return fault(at + 8, reason);
            }
            streams.push(Stream { number: i + 1, offset, packed, plain: wanted });
        }
        offset += packed;
    }
    if streams.len() != expected.len() {
        return fault(15, format!("found {} streams with values, expected {}", streams.len(), expected.len()));
    }
    if offset != bytes.len() {
        return fault(offset, format!("found {} bytes after the last stream, expected the end", bytes.len() - offset));
    }
    Ok(streams)
}

/// The frame must fill the section exactly.
fn inflate(packed: &[u8], section: &mut [u8]) -> std::result::Result<(), String> {
    let window = MIN_WINDOW.max(section.len() as u64);
    let zstd = |error: &dyn std::fmt::Display| format!("zstd: {error}");
    let mut decoder = StreamingDecoder::new_with_max_window_size(packed, window).map_err(|error| zstd(&error))?;
    // 0 if the frame does not state it.
    let stated = decoder.decoder.content_size();
    if stated != 0 && stated != section.len() as u64 {
        return Err(format!("found a frame of {stated} bytes, expected {}", section.len()));
    }
    decoder.read_exact(section).map_err(|error| zstd(&error))?;
    if decoder.read(&mut [0]).map_err(|error| zstd(&error))? > 0 {
        return Err(format!("found more than {} bytes, expected the end", section.len()));
    }
    let frame = &decoder.decoder;
    match (frame.get_checksum_from_data(), frame.get_calculated_checksum()) {
        (Some(stated), Some(found)) if stated != found => Err(zstd(&"the checksum does not match")),
        _ => Ok(()),
    }
}

pub(super) fn write(layout: &Layout, scene: &Scene, count: u32, out: &mut dyn Write) -> std::io::Result<()> {
    let mut sections = Vec::new();
    layout.encode(scene, |section| {
        sections.push(section);
        Ok(())
    })?;
    sections.retain(|section| !section.is_empty());
    let pack = |level| sections.par_iter().map(|section| compress_to_vec(&section[..], level)).collect();
    let mut packed: Vec<Vec<u8>> = pack(CompressionLevel::Fastest);
    let bytes = |streams: &[Vec<u8>]| streams.iter().map(|stream| stream.len() as u64).sum::<u64>();
    // Equal Gaussians compress beyond the limit of readers.
    if bytes(&sections) > MAX_INFLATION * bytes(&packed) {
        packed = pack(CompressionLevel::Uncompressed);
    }
    for word in [MAGIC, VERSION, count] {
        out.write_all(&word.to_le_bytes())?;
    }
    out.write_all(&layout.fields())?;
    out.write_all(&[packed.len() as u8])?;
    out.write_all(&(HEADER as u32).to_le_bytes())?;
    out.write_all(&[0; HEADER - 20])?;
    for (packed, plain) in packed.iter().zip(&sections) {
        out.write_all(&(packed.len() as u64).to_le_bytes())?;
        out.write_all(&(plain.len() as u64).to_le_bytes())?;
    }
    packed.iter().try_for_each(|stream| out.write_all(stream))
}
