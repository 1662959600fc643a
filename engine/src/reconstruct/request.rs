//! The request of a reconstruction, and the shape of the work that follows from it.

use crate::{
    Error, Result,
    ops::Pool,
    stages::{
        Architecture, ViewGrid,
        cluster::{ROUNDS, auto_ratio, cluster_count, even_indices, random_indices},
    },
    types::{Camera, Image, LeftOut},
};

/// Most views of one reconstruction.
pub const MAX_VIEWS: usize = 192;

/// Most patches of all views: what kernels count of each fits 32 bits.
pub const MAX_PATCHES: usize = 1 << 20;

/// Most rounds of k-means; it has settled long before.
const MAX_ROUNDS: usize = 100;

/// Share of the tokens that are kept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ratio {
    /// A number in (0, 1]; at 1 every token is kept and nothing is clustered.
    Fixed(f64),
    /// 0.5 sqrt(2 / views), the paper's.
    Auto,
}

/// How the kept tokens are chosen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Selection {
    /// The nearest token of each centroid after so many rounds of k-means, at least one; the paper's are
    /// [`Selection::KMEANS`].
    Kmeans(usize),
    /// Evenly spread.
    Stride,
    /// Random ones, the same for the same seed.
    Random(u64),
    /// The tokens with these indices.
    Given(Vec<u32>),
}

impl Selection {
    /// k-means with the reference's number of rounds.
    pub const KMEANS: Self = Self::Kmeans(ROUNDS);
}

/// A request: what to reconstruct and how.
#[derive(Clone, Debug)]
pub struct Request {
    /// Share of tokens kept.
    pub ratio: Ratio,
    /// How they are chosen.
    pub selection: Selection,
    /// Known cameras of all views, of the images' own size, or none.
    pub cameras: Option<Vec<Camera>>,
    /// Length in the unit of `cameras`, and of the scene, that the network takes for 1: what the photos see at a median distance
    /// of about 1 from the first is what it is trained with.
    pub unit: f64,
    /// Patches along each side of a group that attention across views, and of kept tokens to all, sees as one: the mean of their keys
    /// and that of their values. 1 to [`Pool::MAX_SIDE`]; at 1 it sees every patch. The more there are, the faster and the
    /// less exact; it pays with many photos.
    pub pool: usize,
}

impl Default for Request {
    /// Every token, no cameras, the network's own unit, nothing pooled.
    fn default() -> Self {
        Self { ratio: Ratio::Fixed(1.0), selection: Selection::KMEANS, cameras: None, unit: 1.0, pool: 1 }
    }
}

/// Everything that decides a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Views and their patches.
    pub grid: ViewGrid,
    /// Tokens kept; all where equal to the grid's.
    pub tokens: usize,
    /// How those are found.
    pub kept: Kept,
    /// Whether cameras are given.
    pub cameras: bool,
    /// See [`Request::pool`].
    pub pool: usize,
}

/// Tokens that a plan keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kept {
    /// All: nothing is chosen and nothing gathered.
    All,
    /// The nearest of each centroid after so many rounds of k-means.
    Kmeans(usize),
    /// The tokens whose indices are an input.
    Indices,
}

impl Shape {
    /// The shape of a reconstruction from `views` pictures of `[width, height]` pixels; needs no device.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub fn new(
        architecture: &Architecture,
        views: usize,
        [width, height]: [u32; 2],
        chosen: (Ratio, &Selection),
        cameras: bool,
    ) -> Result<Self> {
        let grid = grid(architecture.patch, views, width as usize, height as usize)?;
        let (tokens, kept) = Kept::of(grid, chosen)?;
        Ok(Self { grid, tokens, kept, cameras, pool: 1 })
    }

    /// The same with keys and values pooled: [`Request::pool`].
    ///
    /// # Errors
    /// [`Error::Argument`] for a side that cannot be used.
    pub fn pooled(self, pool: usize) -> Result<Self> {
        Pool::check(pool)?;
        Ok(Self { pool, ..self })
    }

    /// Stages and passes that a reconstruction of this shape does without, and why.
    pub fn left_out(&self) -> Vec<LeftOut> {
        let mut left_out = Vec::new();
        match self.kept {
            Kept::All => left_out.push(LeftOut::new("cluster", "every token is kept")),
            Kept::Indices => left_out.push(LeftOut::new("cluster", "tokens are not chosen by k-means")),
            Kept::Kmeans(_) => {}
        }
        if !self.cameras {
            left_out.push(LeftOut::new("camera encoder", "no cameras are given"));
        }
        if self.pool > 1 {
            let why = format!("attention across views sees the means of {0} x {0} patches", self.pool);
            left_out.push(LeftOut::new("keys of single patches", why));
        }
        left_out
    }
}

impl Kept {
    /// The number of tokens that a share and a selection keep, and how they are found.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub(crate) fn of(grid: ViewGrid, chosen: (Ratio, &Selection)) -> Result<(usize, Self)> {
        let all = grid.tokens();
        if let Selection::Kmeans(rounds) = chosen.1
            && !(1..=MAX_ROUNDS).contains(rounds)
        {
            return Err(Error::argument("rounds of k-means", rounds, format!("1 to {MAX_ROUNDS}")));
        }
        let tokens = match chosen {
            (_, Selection::Given(indices)) => {
                if indices.is_empty() || indices.iter().any(|i| *i as usize >= all) {
                    let found = format!("{} indices", indices.len());
                    return Err(Error::argument("given tokens", found, format!("at least one, all below {all}")));
                }
                indices.len()
            }
            (wanted, _) => cluster_count(all, ratio(wanted, grid.views)?),
        };
        let kept = match chosen.1 {
            Selection::Given(_) => Kept::Indices,
            _ if tokens == all => Kept::All,
            Selection::Kmeans(rounds) => Kept::Kmeans(*rounds),
            Selection::Stride | Selection::Random(_) => Kept::Indices,
        };
        Ok((tokens, kept))
    }
}

impl Selection {
    /// The tokens among `all` that are kept, or k-means begins with, `tokens` of them.
    pub(crate) fn indices(&self, all: usize, tokens: usize) -> Vec<u32> {
        match self {
            Self::Kmeans(_) | Self::Stride => even_indices(all, tokens),
            Self::Random(seed) => random_indices(all, tokens, *seed),
            Self::Given(indices) => indices.clone(),
        }
    }
}

/// A ratio as a number.
fn ratio(ratio: Ratio, views: usize) -> Result<f64> {
    match ratio {
        Ratio::Auto => Ok(auto_ratio(views)),
        Ratio::Fixed(r) if r > 0.0 && r <= 1.0 => Ok(r),
        Ratio::Fixed(r) => Err(Error::argument("ratio", r, "a number in (0, 1], or auto")),
    }
}

/// Checks that each image has a camera of its size.
pub(crate) fn check_cameras(cameras: &[Camera], images: &[Image]) -> Result<()> {
    if cameras.len() != images.len() {
        return Err(Error::argument("cameras", cameras.len(), format!("{}, one a view", images.len())));
    }
    for (i, (camera, image)) in cameras.iter().zip(images).enumerate() {
        camera.validate(&format!("camera of view {i}"))?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        if size != (image.width, image.height) {
            let expected = format!("{} x {}, as the image", image.width, image.height);
            return Err(Error::argument(format!("size of camera {i}"), format!("{} x {}", size.0, size.1), expected));
        }
    }
    Ok(())
}

/// Width and height of the images, which must be of one size.
pub(crate) fn size_of(images: &[Image]) -> Result<[u32; 2]> {
    let size = images.first().map_or([0; 2], |first| [first.width, first.height]);
    for (i, image) in images.iter().enumerate() {
        if [image.width, image.height] != size {
            let found = format!("{} x {}", image.width, image.height);
            let expected = format!("{} x {}, as view 0", size[0], size[1]);
            return Err(Error::argument(format!("size of view {i}"), found, expected));
        }
        image.validate()?;
    }
    Ok(size)
}

/// Views of pixels as patches.
pub(crate) fn grid(patch: usize, views: usize, width: usize, height: usize) -> Result<ViewGrid> {
    if !(1..=MAX_VIEWS).contains(&views) {
        return Err(Error::argument("views", views, format!("1 to {MAX_VIEWS}")));
    }
    let fail = |expected| Err(Error::argument("size of the views", format!("{width} x {height}"), expected));
    if width == 0 || height == 0 || !width.is_multiple_of(patch) || !height.is_multiple_of(patch) {
        return fail(format!("multiples of {patch}"));
    }
    let grid = ViewGrid { views, rows: height / patch, columns: width / patch, patch };
    if grid.tokens() > MAX_PATCHES {
        return fail(format!("at most {MAX_PATCHES} patches of {patch} x {patch} in {views} views"));
    }
    Ok(grid)
}
