//! Reconstruction in passes over overlapping blocks of views, joined in one world.

use super::{
    MAX_PHOTOS, MAX_VIEWS, Model, Patches, ReconstructOptions, Reconstruction, Shape, TokenSelection,
    options::check_cameras, patches::all_masked,
};
use crate::{
    Error, Result,
    gpu::{Limits, Profile, Progress, ResidentLayout, StageTimes},
    stages::{
        ViewGrid,
        render::{SceneMemory, SceneTensors},
    },
    types::{Camera, Image, Pose, Scene, Similarity, SkippedPass, median},
};
use glam::DVec3;
use std::{collections::HashMap, ops::ControlFlow};

/// Patches that blocks of views without cameras must share.
const MIN_SHARED: usize = 16;

/// Options of blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BlockOptions {
    /// Maximum views, by default as many as fit.
    pub size: Option<usize>,
    /// Views that neighboring blocks share, approximate if chosen by position. By default a quarter
    /// of the size.
    pub overlap: Option<usize>,
}

/// Number and size of blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockLayout {
    /// Number of views.
    pub views: usize,
    /// Number of blocks.
    pub count: usize,
    /// Views of each block.
    pub size: usize,
    /// Views that neighboring blocks share; 0 for one block.
    pub overlap: usize,
}

/// Views of one pass.
#[derive(Clone, Debug, PartialEq)]
pub struct Block {
    /// Indices of the views, in order. The first is the origin of the pass.
    pub views: Vec<usize>,
    /// Whether the scene has the block's Gaussians of each view: true in one block.
    pub own: Vec<bool>,
    /// See [`ReconstructOptions::scene_scale`].
    pub scene_scale: f64,
}

/// A seam between a block and those before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seam {
    /// Patches that have tokens in both.
    pub shared_patches: usize,
    /// Length of the block's unit in the scene: 1 with known cameras.
    pub scale: f64,
    /// Median distance between the Gaussians of a shared patch, over that from the block's first
    /// camera.
    pub error: Option<f64>,
}

impl BlockLayout {
    /// Smallest block chosen for lack of memory.
    pub(super) const SMALLEST: usize = 8;

    /// Lays out blocks of at most `size` views.
    ///
    /// # Errors
    /// [`Error::Argument`] for an invalid size or overlap.
    pub fn new(views: usize, size: usize, overlap: Option<usize>) -> Result<Self> {
        if !(1..=MAX_VIEWS).contains(&size) && views > 0 {
            return Err(Error::argument("block size", size, format!("1 to {MAX_VIEWS} views")));
        }
        if views <= size {
            return Ok(Self { views, count: 1, size: views, overlap: 0 });
        }
        let overlap = overlap.unwrap_or((size / 4).max(size.min(2) / 2));
        if overlap > 0 && overlap >= size {
            return Err(Error::argument("block overlap", overlap, format!("less than the block size, {size}")));
        }
        Ok(Self { views, count: (views - overlap).div_ceil(size - overlap), size, overlap })
    }

    /// As [`BlockLayout::new`] for passes of this `shape`.
    ///
    /// # Errors
    /// Those of `shape`; [`Error::Argument`] for too many patches, or blocks without known cameras
    /// that share no views.
    pub fn checked(
        views: usize,
        size: usize,
        overlap: Option<usize>,
        shape: impl Fn(usize) -> Result<Shape>,
    ) -> Result<Self> {
        let layout = Self::new(views, size, overlap)?;
        let shape = shape(layout.size)?;
        // Patches have 32-bit indices.
        let most = MAX_PHOTOS.min(u32::MAX as usize / shape.grid.patches());
        if views > most {
            return Err(Error::argument("views", views, format!("1 to {most}")));
        }
        let shares = shape.cameras || layout.count == 1 || layout.overlap > 0;
        let expected = "1 or more, or known cameras: shared views join the blocks";
        if shares { Ok(layout) } else { Err(Error::argument("block overlap", 0, expected)) }
    }

    /// Lays out the largest joined scene, from one block's shape and scene. Also returns its bytes
    /// beyond the block's.
    pub fn scene(&self, limits: &Limits, shape: Shape, block: SceneTensors) -> (SceneTensors, u64) {
        if self.count == 1 {
            return (block, 0);
        }
        let tokens = (self.count * shape.tokens).min(self.views * shape.grid.patches());
        let mut layout = ResidentLayout::new(limits);
        let scene = SceneTensors::lay_out(&mut layout, tokens * (block.len / shape.tokens), block.sh_degree);
        (scene, layout.bytes())
    }

    /// Chooses each block's views by camera positions, or by order. With cameras and several
    /// blocks, `scale` returns a block's scene scale from its cameras in the first's frame and the
    /// first's pose.
    pub fn blocks(
        &self,
        cameras: Option<&[Camera]>,
        scene_scale: f64,
        scale: impl Fn(&[Camera], &Pose) -> Result<f64>,
    ) -> Result<Vec<Block>> {
        let several = cameras.filter(|_| self.count > 1);
        let chosen = match several {
            Some(cameras) => self.by_position(cameras),
            None => (0..self.count).map(|block| self.by_order(block)).collect(),
        };
        let block = |(part, views): (Vec<usize>, Vec<usize>)| {
            let own = views.iter().map(|view| part.contains(view)).collect();
            let mut block = Block { views, own, scene_scale };
            if let Some(cameras) = several {
                let (cameras, origin) = block.cameras(cameras);
                block.scene_scale = scale(&cameras, &origin)?;
            }
            Ok(block)
        };
        chosen.into_iter().map(block).collect()
    }

    /// Returns a block's own views and all its views. Neighbors halve shared views.
    fn by_order(&self, block: usize) -> (Vec<usize>, Vec<usize>) {
        let start = |block: usize| block * (self.views - self.size) / (self.count - 1).max(1);
        let border = |block: usize| match block {
            0 => 0,
            block if block == self.count => self.views,
            block => (start(block - 1) + self.size + start(block)) / 2,
        };
        ((border(block)..border(block + 1)).collect(), (start(block)..start(block) + self.size).collect())
    }

    fn by_position(&self, cameras: &[Camera]) -> Vec<(Vec<usize>, Vec<usize>)> {
        let places: Vec<DVec3> = cameras.iter().map(|camera| camera.pose.translation).collect();
        let mut parts = Vec::new();
        halve((0..self.views).collect(), self.count, &places, &mut parts);
        parts.into_iter().map(|part| (part.clone(), self.extended(&part, &places))).collect()
    }

    /// Returns a part with the views nearest to it, in order.
    fn extended(&self, part: &[usize], places: &[DVec3]) -> Vec<usize> {
        let distance = |view: usize| {
            let distances = part.iter().map(|own| places[view].distance_squared(places[*own]));
            (distances.fold(f64::INFINITY, f64::min), view)
        };
        let mut others: Vec<(f64, usize)> = (0..self.views).filter(|view| !part.contains(view)).map(distance).collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let others = others.iter().take(self.size - part.len()).map(|(_, view)| view);
        let mut views: Vec<usize> = part.iter().chain(others).copied().collect();
        views.sort_unstable();
        views
    }
}

/// Halves the views across their longest extent, to `count` parts.
fn halve(mut views: Vec<usize>, count: usize, places: &[DVec3], parts: &mut Vec<Vec<usize>>) {
    if count == 1 {
        return parts.push(views);
    }
    let bounds = |pick: fn(DVec3, DVec3) -> DVec3| views.iter().map(|view| places[*view]).reduce(pick);
    let extent = bounds(DVec3::max).unwrap_or_default() - bounds(DVec3::min).unwrap_or_default();
    let axis = (1..3).fold(0, |longest, axis| if extent[axis] > extent[longest] { axis } else { longest });
    views.sort_by(|a, b| places[*a][axis].total_cmp(&places[*b][axis]).then(a.cmp(b)));
    let mut second = views.split_off(views.len() * (count / 2) / count);
    [&mut views, &mut second].into_iter().for_each(|half| half.sort_unstable());
    halve(views, count / 2, places, parts);
    halve(second, count - count / 2, places, parts);
}

impl Block {
    /// Returns its views' cameras in the first's frame, and the first's pose.
    fn cameras(&self, cameras: &[Camera]) -> (Vec<Camera>, Pose) {
        let origin = cameras[self.views[0]].pose;
        let own = |view: &usize| Camera { pose: cameras[*view].pose.relative_to(&origin), ..cameras[*view] };
        (self.views.iter().map(own).collect(), origin)
    }
}

impl Model {
    /// Lays out the blocks of `views` images of `size` pixels.
    ///
    /// # Errors
    /// [`Error::Argument`] for invalid options.
    pub fn block_layout(&self, views: usize, size: [u32; 2], options: &ReconstructOptions) -> Result<BlockLayout> {
        let limits = Limits { memory_bytes: self.available_bytes(), ..self.device.limits().clone() };
        self.network.block_layout(&limits, views, options.blocks, |views| self.shape_of_views(views, size, options))
    }

    /// Returns the device's memory without that of others, such as kept scenes in use.
    fn available_bytes(&self) -> u64 {
        // Another thread may be reconstructing.
        let recorded = self.recorded.try_lock();
        let kept = recorded.iter().flat_map(|recorded| recorded.iter().flat_map(|recorded| &recorded.scenes));
        let kept: u64 = kept.filter(|scene| scene.is_free()).map(|scene| scene.resident().bytes()).sum();
        let own = self.weight_bytes() + self.arena.bytes() + kept;
        self.device.limits().memory_bytes.saturating_sub(self.device.allocated_bytes().saturating_sub(own))
    }

    /// Checks that the passes fit, then the scene of all views.
    fn check_memory(&self, views: usize, shape: Shape) -> Result<()> {
        let (plan, available) = (self.plan(shape)?, self.available_bytes());
        let mut layout = ResidentLayout::new(self.device.limits());
        // Each view has the tokens of one block.
        let len = plan.tensors.scene().len * views / shape.grid.views;
        SceneTensors::lay_out(&mut layout, len, plan.tensors.scene().sh_degree);
        let needed = self.weight_bytes() + plan.bytes().max(layout.bytes());
        let what = format!("the scene of {views} views in blocks");
        if needed > available { Err(Error::Memory { what, needed, available }) } else { Ok(()) }
    }

    /// As [`Model::reconstruct_views`], in a pass per block. Known cameras or shared patches place
    /// the blocks.
    ///
    /// # Errors
    /// Those of [`Model::reconstruct_views`]; [`Error::Argument`] for given tokens, or blocks that
    /// share too few patches; [`Error::Memory`] before the first pass if the scene does not fit.
    pub fn reconstruct_blocks(
        &self,
        images: &[Image],
        options: &ReconstructOptions,
        blocks: &[Block],
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        if let [_] | [] = blocks {
            return self.reconstruct_views(images, options, progress);
        }
        if let TokenSelection::Given(_) = options.token_selection {
            return Err(Error::argument("token selection", "given tokens", "another selection, or one block of views"));
        }
        options.cameras.as_deref().map_or(Ok(()), |cameras| check_cameras(cameras, images))?;
        let mut joined = Joined::default();
        for (i, block) in blocks.iter().enumerate() {
            let views: Vec<Image> = block.views.iter().map(|view| images[*view].clone()).collect();
            let (cameras, origin) = options.cameras.as_deref().map(|cameras| block.cameras(cameras)).unzip();
            let options = ReconstructOptions { cameras, scene_scale: Some(block.scene_scale), ..options.clone() };
            if i == 0 {
                self.check_memory(images.len(), self.shape(&views, &options)?)?;
            }
            let made = self.pass(&views, &options, |now| {
                progress(Progress { fraction: (i as f64 + now.fraction) / blocks.len() as f64, ..now })
            })?;
            joined.add(made, i, block, origin)?;
        }
        joined.finish(self, images.len())
    }
}

#[derive(Default)]
struct Joined {
    scene: Scene,
    /// Patches of the scene's tokens.
    kept: Vec<u32>,
    /// Means of all blocks' tokens, by patch.
    means: HashMap<u32, DVec3>,
    seams: Vec<Seam>,
    skipped_passes: Vec<SkippedPass>,
    shape: Option<(ViewGrid, bool)>,
    times: StageTimes,
    outline: Profile,
    peak_bytes: u64,
}

impl Joined {
    fn add(&mut self, made: Reconstruction, i: usize, block: &Block, origin: Option<Pose>) -> Result<()> {
        let mut scene = made.to_scene()?;
        let means = if scene.is_empty() { Vec::new() } else { made.patches.means(&scene)? };
        let patches = made.patches.grid.patches();
        let token = |patch: u32| (patch as usize / patches, patch as usize % patches);
        let tokens: Vec<(usize, usize)> = made.patches.indices().into_iter().map(token).collect();
        let patch = |(view, patch): (usize, usize)| (block.views[view] * patches + patch) as u32;
        let known = tokens.iter().zip(&means).filter_map(|(token, mean)| Some((patch(*token), (*mean)?)));
        let known: Vec<(u32, DVec3)> = known.collect();
        let shared: Vec<[DVec3; 2]> =
            known.iter().filter_map(|(patch, mean)| Some([*mean, *self.means.get(patch)?])).collect();
        let onto = match origin {
            Some(origin) => origin.into(),
            None if i == 0 => Pose::IDENTITY.into(),
            None => joining(&shared, i)?,
        };
        if i > 0 {
            self.seams.push(Seam::new(&shared, &onto));
        }
        known.iter().for_each(|(patch, mean)| _ = self.means.entry(*patch).or_insert(onto.point(*mean)));

        scene.place(onto.scale, &onto.pose);
        let (each, owned) = (scene.len() / tokens.len().max(1), |token: &usize| block.own[tokens[*token].0]);
        let owned: Vec<usize> = (0..tokens.len()).filter(owned).collect();
        scene.keep(&owned.iter().flat_map(|token| token * each..(token + 1) * each).collect::<Vec<_>>());
        self.kept.extend(owned.iter().map(|token| patch(tokens[*token])));
        if i == 0 {
            self.scene = scene
        } else {
            self.scene.append(scene)
        }
        made.times.0.iter().for_each(|(stage, took)| self.times.add(stage, *took));
        self.outline.add(&made.outline);
        self.peak_bytes = self.peak_bytes.max(made.peak_bytes);
        self.skipped_passes = made.skipped_passes;
        self.shape = Some((made.patches.grid, made.patches.posed));
        Ok(())
    }

    fn finish(self, model: &Model, views: usize) -> Result<Reconstruction> {
        let Self { scene, kept, seams, times, outline, skipped_passes, peak_bytes, shape, .. } = self;
        let (grid, posed) = shape.filter(|_| !kept.is_empty()).ok_or_else(all_masked)?;
        let mut layout = ResidentLayout::new(model.device.limits());
        let tensors = SceneTensors::lay_out(&mut layout, scene.len(), scene.sh_degree);
        let gaussians = model
            .in_arena(|_, _| SceneMemory::new(&model.device, &layout, tensors)?.made_in(&model.arena).write(&scene))?;
        Ok(Reconstruction {
            tokens: kept.len(),
            patches: Patches { grid: ViewGrid { views, ..grid }, kept: Some(kept), posed },
            unmasked: None,
            times,
            outline,
            skipped_passes,
            seams,
            peak_bytes: peak_bytes + gaussians.bytes(),
            gaussians,
            placement: None,
        })
    }
}

/// Returns the similarity from block `i` of views to the scene.
fn joining(shared: &[[DVec3; 2]], i: usize) -> Result<Similarity> {
    let found = Similarity::of_shared_points(shared).filter(|_| shared.len() >= MIN_SHARED);
    found.ok_or_else(|| {
        let what = format!("patches that block {} of views shares with those before it", i + 1);
        let expected = format!("{MIN_SHARED} or more: a larger block overlap or ratio shares more");
        Error::argument(what, shared.len(), expected)
    })
}

impl Seam {
    fn new(shared: &[[DVec3; 2]], onto: &Similarity) -> Self {
        let apart = |[a, b]: &[DVec3; 2]| onto.point(*a).distance(*b) / (onto.scale * a.length());
        Self { shared_patches: shared.len(), scale: onto.scale, error: median(shared.iter().map(apart)) }
    }
}
