//! Arena offsets: tensors with disjoint lifetimes share bytes.

/// Vulkan's upper bound on minimum offset alignments.
pub(crate) const ALIGNMENT: u64 = 256;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Lifetime {
    pub bytes: u64,
    pub first: u32,
    pub last: u32,
}

#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Placement {
    pub block: u32,
    pub offset: u64,
    pub first: u32,
    pub last: u32,
}

/// Places lifetimes, largest first, at their lowest free offset in blocks of up to `block_bytes`.
/// `Err` is the index of one that exceeds a block.
pub(crate) fn place(lifetimes: &[Lifetime], block_bytes: u64) -> Result<(Vec<Placement>, Vec<u64>), usize> {
    let mut order: Vec<usize> = (0..lifetimes.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(lifetimes[i].bytes), i));
    let mut blocks: Vec<(u64, Vec<usize>)> = Vec::new();
    let mut placements = vec![Placement::default(); lifetimes.len()];
    for i in order {
        let life = lifetimes[i];
        let bytes = life.bytes.next_multiple_of(ALIGNMENT).max(ALIGNMENT);
        if bytes > block_bytes {
            return Err(i);
        }
        let gap = |members: &[usize]| lowest_gap(members, &placements, lifetimes, life, bytes);
        let found = blocks
            .iter()
            .enumerate()
            .map(|(b, (_, members))| (b, gap(members)))
            .find(|(_, offset)| offset + bytes <= block_bytes);
        let (block, offset) = found.unwrap_or_else(|| {
            blocks.push((0, Vec::new()));
            (blocks.len() - 1, 0)
        });
        placements[i] = Placement { block: block as u32, offset, first: life.first, last: life.last };
        blocks[block].0 = blocks[block].0.max(offset + bytes);
        blocks[block].1.push(i);
    }
    Ok((placements, blocks.into_iter().map(|b| b.0).collect()))
}

fn lowest_gap(members: &[usize], placed: &[Placement], lives: &[Lifetime], life: Lifetime, bytes: u64) -> u64 {
    let mut taken: Vec<_> = members
        .iter()
        .filter(|&&m| lives[m].first <= life.last && life.first <= lives[m].last)
        .map(|&m| (placed[m].offset, placed[m].offset + lives[m].bytes.next_multiple_of(ALIGNMENT).max(ALIGNMENT)))
        .collect();
    taken.sort_unstable();
    let mut offset = 0;
    for (from, to) in taken {
        if offset + bytes <= from {
            break;
        }
        offset = offset.max(to);
    }
    offset
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn living_tensors_never_overlap_and_dead_ones_share() {
        let mut state = 7u64;
        let mut random = |n: u64| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) % n
        };
        let lives: Vec<_> = (0..300)
            .map(|_| {
                let first = random(1000) as u32;
                Lifetime { bytes: random(100_000), first, last: first + random(30) as u32 }
            })
            .collect();
        let (placed, blocks) = place(&lives, 1 << 20).unwrap();
        for (i, (a, p)) in lives.iter().zip(&placed).enumerate() {
            assert!(p.offset.is_multiple_of(ALIGNMENT) && p.offset + a.bytes <= blocks[p.block as usize]);
            for (b, q) in lives.iter().zip(&placed).skip(i + 1) {
                let meet = a.first <= b.last && b.first <= a.last && p.block == q.block;
                assert!(!meet || p.offset + a.bytes <= q.offset || q.offset + b.bytes <= p.offset);
            }
        }
        let total: u64 = lives.iter().map(|l| l.bytes).sum();
        assert!(blocks.iter().sum::<u64>() < total / 5, "{blocks:?} of {total}");
    }

    #[test]
    fn a_tensor_larger_than_a_block_is_named() {
        let lives = [Lifetime { bytes: 10, first: 0, last: 0 }, Lifetime { bytes: 5000, first: 0, last: 0 }];
        assert_eq!(place(&lives, 4096).unwrap_err(), 1);
    }
}
