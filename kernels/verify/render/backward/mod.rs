mod cameras;
mod color;
mod project;
pub(crate) mod rasterize;

pub use cameras::area as cameras;
pub use color::area as color;
pub use project::area as project;

use crate::{bound::Bounded, trial::Trial};
use zipsplat::gpu::Tensor;

fn added_to(trial: &mut Trial<'_>, len: usize, before: f32) -> Tensor {
    let tensor = trial.rec.tensor::<f32>("sums", len);
    trial.rec.fill(tensor, before.to_bits());
    tensor
}

type Vector = [Bounded; 3];

fn plus(a: Vector, b: Vector) -> Vector {
    [0, 1, 2].map(|c| a[c] + b[c])
}

fn minus(a: Vector, b: Vector) -> Vector {
    [0, 1, 2].map(|c| a[c] - b[c])
}

fn times(by: Bounded, a: Vector) -> Vector {
    a.map(|a| by * a)
}

fn cross(a: Vector, b: Vector) -> Vector {
    [[1, 2], [2, 0], [0, 1]].map(|[i, j]| a[i] * b[j] - a[j] * b[i])
}
