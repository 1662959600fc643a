//! Writing one gzip stream (RFC 1952) on all cores: parts are packed at the same time, each up to a flush, and follow each
//! other. The bytes do not depend on the number of cores.

use std::io::Write;

use flate2::{Compress, Compression, Crc, FlushCompress};
use rayon::prelude::*;

/// Bytes of a part. What one repeats of another is not seen, which costs little of so many.
const PART: usize = 1 << 20;
/// Deflate with a comment behind this, without a name, a time or a system.
const START: [u8; 10] = [0x1f, 0x8b, 8, 16, 0, 0, 0, 0, 0, 0xff];
/// An empty last block of deflate.
const LAST_BLOCK: [u8; 2] = [3, 0];

/// A stream in the making.
pub(super) struct Gzip<'a> {
    out: &'a mut dyn Write,
    sum: Crc,
}

impl<'a> Gzip<'a> {
    /// Writes the header with a comment, which has no NUL.
    pub(super) fn begin(out: &'a mut dyn Write, comment: &str) -> std::io::Result<Self> {
        out.write_all(&START)?;
        out.write_all(comment.as_bytes())?;
        out.write_all(&[0])?;
        Ok(Self { out, sum: Crc::new() })
    }

    /// Packs all of `bytes`.
    pub(super) fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        let parts: Vec<_> = bytes.par_chunks(PART).map(pack).collect();
        for part in parts {
            let (packed, sum) = part?;
            self.out.write_all(&packed)?;
            self.sum.combine(&sum);
        }
        Ok(())
    }

    pub(super) fn finish(self) -> std::io::Result<()> {
        self.out.write_all(&LAST_BLOCK)?;
        self.out.write_all(&self.sum.sum().to_le_bytes())?;
        self.out.write_all(&self.sum.amount().to_le_bytes())
    }
}

/// Blocks of deflate that end with a whole byte, none of them the last, and the checksum of what they hold.
fn pack(bytes: &[u8]) -> std::io::Result<(Vec<u8>, Crc)> {
    let mut deflate = Compress::new(Compression::default(), false);
    let mut packed = Vec::with_capacity(bytes.len() / 2 + 64);
    // Where room is left behind it the flush is complete.
    while packed.len() == packed.capacity() || deflate.total_in() < bytes.len() as u64 {
        packed.reserve(bytes.len() / 8 + 64);
        let rest = &bytes[deflate.total_in() as usize..];
        deflate.compress_vec(rest, &mut packed, FlushCompress::Sync).map_err(std::io::Error::other)?;
    }
    let mut sum = Crc::new();
    sum.update(bytes);
    Ok((packed, sum))
}
