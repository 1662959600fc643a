//! Parallel gzip (RFC 1952): parts are compressed independently and concatenated. The bytes do not
//! depend on the number of cores.

use std::io::Write;

use flate2::{Compress, Compression, Crc, FlushCompress};
use rayon::prelude::*;

/// Matches across parts are lost, which costs little at this size.
const PART: usize = 1 << 20;
/// Deflate with a comment; no name, time or system.
const START: [u8; 10] = [0x1f, 0x8b, 8, 16, 0, 0, 0, 0, 0, 0xff];
/// Empty final deflate block.
const LAST_BLOCK: [u8; 2] = [3, 0];

pub(super) struct Gzip<'a> {
    out: &'a mut dyn Write,
    sum: Crc,
}

impl<'a> Gzip<'a> {
    /// The comment must not contain NUL.
    pub(super) fn begin(out: &'a mut dyn Write, comment: &str) -> std::io::Result<Self> {
        out.write_all(&START)?;
        out.write_all(comment.as_bytes())?;
        out.write_all(&[0])?;
        Ok(Self { out, sum: Crc::new() })
    }

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

/// Returns byte-aligned deflate blocks, none final, and their contents' checksum.
fn pack(bytes: &[u8]) -> std::io::Result<(Vec<u8>, Crc)> {
    let mut deflate = Compress::new(Compression::default(), false);
    let mut packed = Vec::with_capacity(bytes.len() / 2 + 64);
    // Spare capacity means that the flush is complete.
    while packed.len() == packed.capacity() || deflate.total_in() < bytes.len() as u64 {
        packed.reserve(bytes.len() / 8 + 64);
        let rest = &bytes[deflate.total_in() as usize..];
        deflate.compress_vec(rest, &mut packed, FlushCompress::Sync).map_err(std::io::Error::other)?;
    }
    let mut sum = Crc::new();
    sum.update(bytes);
    Ok((packed, sum))
}
