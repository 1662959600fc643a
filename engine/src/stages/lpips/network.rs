use super::features::Pool;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsNetwork {
    /// VGG16, as the reference.
    Vgg,
    /// AlexNet: faster, for evaluation.
    Alex,
}

pub(super) struct Recipe {
    pub outputs: usize,
    pub side: usize,
    pub step: usize,
    pub padding: usize,
    pub pool: Option<Pool>,
    pub tap: bool,
}

impl LpipsNetwork {
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg => "vgg",
            Self::Alex => "alex",
        }
    }

    pub fn least_side(self) -> u32 {
        match self {
            Self::Vgg => 16,
            Self::Alex => 31,
        }
    }

    pub(super) fn recipes(self) -> Vec<Recipe> {
        match self {
            Self::Vgg => {
                let stages = [(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)];
                let of_stage = |(stage, (outputs, count)): (usize, (usize, usize))| {
                    (0..count).map(move |i| Recipe {
                        outputs,
                        side: 3,
                        step: 1,
                        padding: 1,
                        pool: (stage > 0 && i == 0).then_some(Pool { side: 2, step: 2 }),
                        tap: i + 1 == count,
                    })
                };
                stages.into_iter().enumerate().flat_map(of_stage).collect()
            }
            Self::Alex => {
                let layers = [(64, 11, 4, 2, false), (192, 5, 1, 2, true), (384, 3, 1, 1, true), (256, 3, 1, 1, false)];
                let recipe = |(outputs, side, step, padding, pooled): (usize, usize, usize, usize, bool)| Recipe {
                    outputs,
                    side,
                    step,
                    padding,
                    pool: pooled.then_some(Pool { side: 3, step: 2 }),
                    tap: true,
                };
                layers.into_iter().chain([(256, 3, 1, 1, false)]).map(recipe).collect()
            }
        }
    }
}
