use crate::prelude::*;
use zipsplat::{refine::Exposed, stages::FrameShape};
use zipsplat_reference::refine::exposure::{exposed, exposure_backward};

const REASON: &str = "products round once; sums of a color's terms and over pixels, in any order, relative to the terms; \
    values within their error of a saturated photo's white or black may be hidden or not";

/// Additions of a run, a subgroup and a picture, and a rounding of each product.
const ADDITIONS: usize = 2 * 8 + 128 + 8 + 1;

struct Problem {
    pixels: usize,
    /// `[photos, 3, 4]`.
    transforms: Vec<f32>,
    /// `[photos, pixels, 3]` each.
    frames: Vec<f32>,
    targets: Vec<f32>,
    gradient: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    HalfResult,
    Transposed,
    NoOffset,
    NothingHidden,
    /// Photos that are not saturated hide values beyond 0 and 1.
    AllHidden,
    NeighborPhoto,
    NeighborPixel,
}

impl Problem {
    /// A fifth of the target values is 0 and a fifth 1, if `saturated`.
    fn new(photos: usize, pixels: usize, saturated: bool) -> Self {
        let mut noise = Noise::new((photos + pixels) as u64);
        let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let transforms =
            noise.values(12 * photos).iter().enumerate().map(|(i, x)| identity[i % 12] + 0.3 * x).collect();
        let count = 3 * photos * pixels;
        let frames = noise.values(count).iter().map(|x| 0.5 + 0.8 * x).collect();
        let target = |(i, x): (usize, &f32)| match i % 5 {
            0 if saturated => 0.0,
            1 if saturated => 1.0,
            _ => 0.5 + 0.4 * x,
        };
        let targets = noise.values(count).iter().enumerate().map(target).collect();
        Self { pixels, transforms, frames, targets, gradient: noise.values(count) }
    }

    fn photos(&self) -> usize {
        self.transforms.len() / 12
    }

    /// Exposed frames, gradients by the frames, gradients by the transforms.
    fn of(&self, transforms: &[f64], targets: &[f64]) -> Vec<f64> {
        let (frames, gradient) = (widen(&self.frames), widen(&self.gradient));
        let (mut values, mut d_frames, mut d_transforms) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..self.photos() {
            let of = |values: &[f64]| values[3 * self.pixels * i..3 * self.pixels * (i + 1)].to_vec();
            let (frame, target, transform) = (of(&frames), of(targets), &transforms[12 * i..12 * (i + 1)]);
            values.extend(exposed(&frame, &target, transform));
            let (d_frame, d_transform) = exposure_backward(&frame, &target, transform, &of(&gradient));
            d_frames.extend(d_frame);
            d_transforms.extend(d_transform);
        }
        [values, d_frames, d_transforms].concat()
    }

    fn errors(&self) -> Vec<f64> {
        let count = self.frames.len();
        let mut errors = vec![TINY; 2 * count + self.transforms.len()];
        for i in 0..count {
            let (pixel, row) = (i / 3 * 3, 12 * (i / (3 * self.pixels)) + i % 3 * 4);
            let color = [0, 1, 2, 3].map(|k| if k < 3 { f64::from(self.frames[pixel + k]) } else { 1.0 });
            let factors = [0, 1, 2, 3].map(|k| f64::from(self.transforms[row + k]));
            let terms = [0, 1, 2, 3].map(|k| color[k] * factors[k]);
            errors[i] += gamma(5) * terms.map(f64::abs).iter().sum::<f64>();
            let (value, target) = (terms.iter().sum::<f64>(), f64::from(self.targets[i]));
            let is_saturated = target >= 1.0 || target <= 0.0;
            let beyond = if target >= 1.0 { value - 1.0 } else { -value };
            if is_saturated && beyond > errors[i] {
                continue;
            }
            let is_near = is_saturated && beyond >= -errors[i];
            let [by_color, by_pixels] = [5, ADDITIONS].map(|count| if is_near { 1.0 } else { gamma(count) });
            let gradient = f64::from(self.gradient[i]).abs();
            for k in 0..4 {
                if k < 3 {
                    errors[count + pixel + k] += by_color * gradient * factors[k].abs();
                }
                errors[2 * count + row + k] += by_pixels * gradient * color[k].abs();
            }
        }
        errors
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let inputs = [&self.frames, &self.targets, &self.transforms].map(|values| trial.input(values));
        let gradient = trial.input(&self.gradient);
        let shape = FrameShape { cameras: self.photos(), width: self.pixels as u32, height: 1 };
        let frames = Exposed::record(&mut trial.rec, inputs, shape);
        let d_transforms = frames.record_backward(&mut trial.rec, gradient);
        Ok(trial.results([frames.exposed, gradient, d_transforms])?.concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        [self.of(&widen(&self.transforms), &widen(&self.targets)), self.errors()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (transforms, targets) = (widen(&self.transforms), widen(&self.targets));
        let number = |of: &dyn Fn(usize) -> f64| (0..transforms.len()).map(of).collect::<Vec<_>>();
        match fault {
            Fault::HalfResult => halves(truth),
            Fault::Transposed => {
                let of = |i: usize| match (i % 12 / 4, i % 4) {
                    (_, 3) => transforms[i],
                    (row, column) => transforms[i / 12 * 12 + 4 * column + row],
                };
                self.of(&number(&of), &targets)
            }
            Fault::NoOffset => self.of(&number(&|i| if i % 4 == 3 { 0.0 } else { transforms[i] }), &targets),
            Fault::NothingHidden => self.of(&transforms, &vec![0.5; targets.len()]),
            Fault::AllHidden => {
                let values: Vec<f64> = self.of(&transforms, &vec![0.5; targets.len()]);
                let edges: Vec<f64> =
                    values[..targets.len()].iter().map(|x| if *x > 0.5 { 1.0 } else { 0.0 }).collect();
                self.of(&transforms, &edges)
            }
            Fault::NeighborPhoto => self.of(&shifted(&transforms, 12), &targets),
            Fault::NeighborPixel => shifted(truth, 3),
        }
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("refine/exposure", "pixels", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, photos: usize, pixels: usize, saturated, catches: Catches<Fault>| {
        area.add(name, photos * pixels, catches, move || Problem::new(photos, pixels, saturated));
    };
    let all = || Catches::from([HalfResult, Transposed, NoOffset, NeighborPixel]);
    add("saturated photos", 3, 1001, true, all().and(&[NothingHidden, NeighborPhoto]));
    add("one photo, not saturated", 1, 4097, false, all().and(&[AllHidden]));
    add("pictures of one pixel", 65, 1, true, all().and(&[NothingHidden, NeighborPhoto]));
    area
}
