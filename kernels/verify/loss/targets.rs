use crate::prelude::*;
use zipsplat::stages::loss::record_targets;
use zipsplat_reference::loss::targets::targets;

const REASON: &str = "one division of integers, within 3 units (2.5 by Vulkan)";

struct Problem(Vec<u8>);

#[derive(Clone, Copy, Debug)]
enum Fault {
    Reversed,
    By256,
    NeighborValue,
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let words: Vec<u32> = self.0.chunks(4).map(word).collect();
        let photos = trial.input(&words);
        let targets = record_targets(&mut trial.rec, photos, self.0.len());
        trial.result(targets)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let truth = targets(&self.0);
        let errors = truth.iter().map(|value| gamma(3) * value).collect();
        [truth, errors]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        match fault {
            // The last word may be shorter.
            Fault::Reversed => truth.chunks(4).flat_map(|four| four.iter().rev().copied()).collect(),
            Fault::By256 => truth.iter().map(|value| value * 255.0 / 256.0).collect(),
            Fault::NeighborValue => (0..truth.len()).map(|i| truth[(i + 1) % truth.len()]).collect(),
        }
    }
}

fn word(four: &[u8]) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| four.get(i).copied().unwrap_or(0)))
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("loss/targets", "values", Mode::ONLY_EXACT, REASON);
    let all = [Reversed, By256, NeighborValue];
    area.add("all bytes", 1023, all, || Problem((0..1023u32).map(|i| (i * 7 % 256) as u8).collect()));
    area.add("part of a word", 3, all, || Problem(vec![1, 128, 255]));
    area
}
