use crate::prelude::*;
use zipsplat::refine::record_dropout;
use zipsplat_reference::refine::dropout::is_hidden;

const REASON: &str = "products round once, as does their factor; zeros are exact";

struct Problem {
    opacities: Vec<f32>,
    key: u32,
    fraction: f64,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    OtherKey,
    OtherFraction,
    AllShown,
    NotScaled,
    NotBounded,
    Complement,
    NeighborGaussian,
}

impl Problem {
    fn shown(&self, key: u32, fraction: f64) -> Vec<f64> {
        let least = (fraction * f64::from(u32::MAX)) as u32;
        let shown = |(i, opacity): (usize, &f32)| match is_hidden(i as u32, key, least) {
            true => 0.0,
            false => (f64::from(*opacity) / (1.0 - fraction)).min(1.0),
        };
        self.opacities.iter().enumerate().map(shown).collect()
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let (opacities, key) = (trial.input(&self.opacities), trial.input(&[self.key]));
        let shown = record_dropout(&mut trial.rec, opacities, key, self.fraction, self.opacities.len());
        trial.result(shown)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let shown = self.shown(self.key, self.fraction);
        let errors = shown.iter().map(|value| ULP * value).collect();
        [shown, errors]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let all = widen(&self.opacities);
        match fault {
            Fault::OtherKey => self.shown(self.key + 1, self.fraction),
            Fault::OtherFraction => self.shown(self.key, 1.1 * self.fraction),
            Fault::AllShown => all,
            Fault::NotScaled => all.iter().zip(truth).map(|(opacity, shown)| opacity.min(*shown)).collect(),
            Fault::NotBounded => {
                let scaled = all.iter().map(|opacity| opacity / (1.0 - self.fraction));
                scaled.zip(truth).map(|(scaled, shown)| if *shown > 0.0 { scaled } else { 0.0 }).collect()
            }
            Fault::Complement => all.iter().zip(truth).map(|(opacity, shown)| opacity - shown).collect(),
            Fault::NeighborGaussian => (0..truth.len()).map(|i| truth[(i + 1) % truth.len()]).collect(),
        }
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("refine/dropout", "values", Mode::ONLY_EXACT, REASON);
    for (count, key, fraction) in [(4097, 7, 0.1), (64, 0x9e37_79b9, 0.5)] {
        let catches = [OtherKey, OtherFraction, AllShown, NotScaled, NotBounded, Complement, NeighborGaussian];
        area.add(format!("{count} Gaussians"), count, catches, move || Problem {
            opacities: Noise::new(key.into()).values(count).iter().map(|x| 0.5 + 0.5 * x).collect(),
            key,
            fraction,
        });
    }
    area
}
