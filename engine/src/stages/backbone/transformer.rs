use crate::{
    Result,
    gpu::{Element, Recorder, Run, Tensor},
    kernels::backbone::Tokens,
    ops::{Block, KvPool, Norm, Parameters, Rotary, Rows, Sequences},
    stages::{BackboneArchitecture, POSE_ENCODING, Reference, ViewGrid},
};

pub(super) struct Transformer {
    pub architecture: BackboneArchitecture,
    pub blocks: Vec<Block>,
    /// Of global tokens at out layers.
    pub final_norm: Option<Norm>,
    pub special: Box<dyn SpecialTokens>,
}

/// Differences of backbones: special tokens and positions.
pub(super) trait SpecialTokens: Send + Sync {
    /// Special tokens per view.
    fn leading(&self) -> usize;

    /// Allocates inputs besides pixels.
    fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor>;

    /// Returns the tokens of the first block, `[views, leading + patches, width]`.
    fn first(&self, rec: &mut Recorder, images: Tensor, inputs: &[Tensor], grid: ViewGrid) -> Rows;

    /// Chooses a reference view `[1]` u32 before the last block of separate views.
    fn choose(&self, _: &mut Recorder, _: Rows, _: &[Tensor], _: ViewGrid) -> Option<Tensor> {
        None
    }

    /// Returns the tokens of the first block that may be global.
    fn joined(
        &self,
        rec: &mut Recorder,
        x: Rows,
        inputs: &[Tensor],
        reference: Reference,
        chosen: Option<Tensor>,
        grid: ViewGrid,
    ) -> Rows;

    fn rotary(&self, inputs: &[Tensor], grid: ViewGrid, global: bool) -> Rotary;

    fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        poses: Option<&[[f32; POSE_ENCODING]]>,
        parameters: &Parameters,
    ) -> Result<()>;
}

/// Places `special` tokens `[kinds, leading, width]` ahead of each view's patches and adds
/// `positions`. The first kind is the `reference` view's, the last the others'.
pub(super) fn place_tokens(
    rec: &mut Recorder,
    patches: Rows,
    special: Tensor,
    leading: usize,
    [kinds, reference]: [usize; 2],
    positions: Option<Tensor>,
    grid: ViewGrid,
) -> Rows {
    let tokens = leading + grid.patches();
    let out = Rows::scratch(rec, "tokens", grid.views * tokens, patches.width, Element::F32);
    let kernel = Tokens {
        patches: patches.tensor,
        special,
        positions: positions.unwrap_or(special),
        out: out.tensor,
        views: grid.views as u32,
        tokens: tokens as u32,
        width: patches.width as u32,
        leading: leading as u32,
        reference: reference as u32,
        others: kinds as u32 - 1,
        placed: positions.is_some(),
    };
    rec.dispatch(kernel, out.values());
    out
}

/// Tokens at an out layer, special tokens first.
#[derive(Clone, Copy)]
pub(super) struct OutLayer {
    pub local: Rows,
    pub global: Rows,
    pub leading: usize,
}

#[derive(Clone, Copy)]
pub(super) struct Views {
    pub grid: ViewGrid,
    pub reference: Reference,
    pub pool: KvPool,
}

impl Transformer {
    pub fn record(
        &self,
        rec: &mut Recorder,
        images: Tensor,
        inputs: &[Tensor],
        Views { grid, reference, pool }: Views,
        mut out: impl FnMut(&mut Recorder, usize, OutLayer),
    ) {
        let (a, leading) = (&self.architecture, self.special.leading());
        let tokens = leading + grid.patches();
        let mut x = self.special.first(rec, images, inputs, grid);
        rec.observe("bb/tokens0", x.tensor);
        let mut chosen = None;
        // Copied before a global block overwrites it.
        let mut local = x;
        let mut global_blocks = 0;
        for (i, block) in self.blocks.iter().enumerate() {
            if i + 1 == a.alt_start && reference == Reference::Balanced {
                chosen = self.special.choose(rec, x, inputs, grid);
            }
            if i == a.alt_start {
                x = self.special.joined(rec, x, inputs, reference, chosen, grid);
                rec.observe("bb/alt_in", x.tensor);
            }
            let global = a.is_global(i);
            if global && a.out_layers.contains(&i) {
                local = Rows::scratch(rec, "local", x.count, x.width, Element::F32);
                rec.copy(x.tensor, local.tensor);
            } else if !global {
                local = x;
            }
            let separate = !global || pool.is_local(global_blocks);
            let sequences = Sequences {
                count: if separate { grid.views } else { 1 },
                tokens: if separate { tokens } else { grid.views * tokens },
                rotary: (i >= a.rope_start).then(|| self.special.rotary(inputs, grid, global)),
                pool: pool.pool(global_blocks, [grid.rows, grid.columns], leading).filter(|_| !separate),
            };
            global_blocks += usize::from(global);
            rec.scope("block", |rec| block.record(rec, x, sequences));
            rec.observe(&format!("bb/block{i}"), x.tensor);
            for (layer, _) in a.out_layers.iter().enumerate().filter(|(_, at)| **at == i) {
                rec.scope("features", |rec| out(rec, layer, OutLayer { local, global: x, leading }));
            }
        }
    }
}
