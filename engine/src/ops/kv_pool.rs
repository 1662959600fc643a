use super::Pool;
use std::{fmt, str::FromStr};

/// Keys and values of the backbone's attention across views: fewer are faster and less exact.
///
/// As text `auto`, or `1` for every patch, `2` to `4` for means of 2 x 2 to 4 x 4 patches, `local`
/// for the own view's only. `local/3/2` names the first blocks across views, and with the last the
/// others. `+own` leaves each query its own view's patches, `+first` leaves all the first view's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum KvPool {
    /// By the number of views.
    Auto,
    /// A rule.
    Fixed {
        /// Sides of groups per block across views, 0 for attention within a view.
        sides: [u8; KvPool::BLOCKS],
        /// Whether queries see their own view's patches.
        own: bool,
        /// Whether queries see the first view's patches.
        first: bool,
    },
}

impl KvPool {
    /// Blocks beyond are as the last.
    pub const BLOCKS: usize = 32;
    /// Every patch.
    pub const ALL: Self = Self::side(1);

    /// Means of `side` x `side` patches, 1 to [`Pool::MAX_SIDE`].
    pub const fn side(side: u8) -> Self {
        Self::Fixed { sides: [side; Self::BLOCKS], own: false, first: false }
    }

    /// Replaces `Auto` by its rule.
    pub fn for_views(self, views: usize) -> Self {
        match self {
            Self::Auto if views < 48 => Self::ALL,
            Self::Auto => Self::Fixed { sides: [3; Self::BLOCKS], own: true, first: false },
            fixed => fixed,
        }
    }

    /// Returns whether this is [`KvPool::ALL`].
    pub fn is_all(self) -> bool {
        matches!(self, Self::Fixed { sides, .. } if sides == [1; Self::BLOCKS])
    }

    /// Returns whether the `block`-th block across views attends within each view.
    pub(crate) fn is_local(self, block: usize) -> bool {
        self.side_of(block) == 0
    }

    pub(crate) fn pool(self, block: usize, grid: [usize; 2], leading: usize) -> Option<Pool> {
        let Self::Fixed { own, first, .. } = self else { return None };
        let side = usize::from(self.side_of(block));
        (side > 1).then_some(Pool { side, grid, leading, own, first })
    }

    fn side_of(self, block: usize) -> u8 {
        match self {
            Self::Auto => 1,
            Self::Fixed { sides, .. } => sides[block.min(Self::BLOCKS - 1)],
        }
    }
}

impl Default for KvPool {
    fn default() -> Self {
        Self::ALL
    }
}

impl fmt::Display for KvPool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::Fixed { sides, own, first } = self else { return f.write_str("auto") };
        let last = sides[Self::BLOCKS - 1];
        let named = sides.iter().rposition(|side| *side != last).map_or(0, |i| i + 1);
        let name = |side: &u8| if *side == 0 { "local".into() } else { side.to_string() };
        f.write_str(&sides[..=named].iter().map(name).collect::<Vec<_>>().join("/"))?;
        f.write_str(if *own { "+own" } else { "" })?;
        f.write_str(if *first { "+first" } else { "" })
    }
}

impl FromStr for KvPool {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("expected auto, or local or 1 to {} per block, as in local/2+own+first", Pool::MAX_SIDE);
        if text == "auto" {
            return Ok(Self::Auto);
        }
        let mut words = text.split('+');
        let side = |word: &str| match word.parse() {
            _ if word == "local" => Ok(0),
            Ok(side) if (1..=Pool::MAX_SIDE as u8).contains(&side) => Ok(side),
            _ => Err(wrong()),
        };
        let named = words.next().unwrap_or_default().split('/').map(side).collect::<Result<Vec<u8>, _>>()?;
        if named.len() > Self::BLOCKS {
            return Err(wrong());
        }
        let sides = std::array::from_fn(|i| named[i.min(named.len() - 1)]);
        let (mut own, mut first) = (false, false);
        for word in words {
            *match word {
                "own" => &mut own,
                "first" => &mut first,
                _ => return Err(wrong()),
            } = true;
        }
        Ok(Self::Fixed { sides, own, first })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_read_as_written() {
        for text in ["auto", "1", "3", "local", "local/local/2+own", "4/2+own+first", "local/1", "2+first"] {
            assert_eq!(text.parse::<KvPool>().expect(text).to_string(), text);
        }
        let many = "2/".repeat(KvPool::BLOCKS) + "1";
        for text in ["", "0", "5", "own", "2+", "2+other", "2//3", "local/", "auto+own", "256", &many] {
            let error = text.parse::<KvPool>().expect_err(text);
            assert!(error.contains("1 to 4") && error.contains("local/2+own+first"), "{text}: {error}");
        }
    }
}
