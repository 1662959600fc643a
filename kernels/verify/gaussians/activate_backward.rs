use crate::prelude::*;
use zipsplat::kernels::gaussians::ActivateBackward;
use zipsplat_reference::gaussians::activate_backward::activate_backward;

const REASON: &str = "running error analysis of each derivative: exp 3 + 2|x| units, division 2.5, the length of a quaternion as \
    a root; harmonics exactly";

/// Values of a Gaussian with band 0.
const WIDTH: usize = 14;

/// `[count, WIDTH]`.
struct Activations {
    raw: Vec<f32>,
    gradient: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    HalfResult,
    NotActivated,
    NoClamp,
    AlongItself,
    NeighborGaussian,
}

impl Activations {
    fn new(count: usize, length: f32) -> Self {
        let mut noise = Noise::new(count as u64);
        let raw = noise.values(count * WIDTH).into_iter().enumerate();
        let quat = |i: usize| (6..10).contains(&(i % WIDTH));
        let raw = raw.map(|(i, r)| if quat(i) { length * r } else { 6.0 * r }).collect();
        Self { raw, gradient: noise.values(count * WIDTH) }
    }

    fn error(&self, i: usize) -> f64 {
        let (x, d) = (Bounded::exact(self.raw[i]), Bounded::exact(self.gradient[i]));
        let one = Bounded::exact(1.0);
        let sigmoid = |x: Bounded| one / (one + (-x).exp());
        match i % WIDTH {
            0..3 if x.value.abs() > 5.0 => 0.0,
            0..3 => (d * Bounded::exact(x.value.abs()).exp()).error,
            3..6 => (d * sigmoid(x - Bounded::exact(4.0))).error,
            6..10 => self.quat_error(i),
            10 => (d * sigmoid(x) * sigmoid(-x)).error,
            _ => 0.0,
        }
    }

    fn quat_error(&self, i: usize) -> f64 {
        let from = i / WIDTH * WIDTH + 6;
        let [q, d] = [&self.raw, &self.gradient].map(|all| [0, 1, 2, 3].map(|c| Bounded::exact(all[from + c])));
        let largest = Bounded::exact(q.iter().fold(0.0, |most, q| q.value.abs().max(most)));
        let scaled = q.map(|q| q / largest);
        let length = Bounded::dot(scaled, scaled).sqrt();
        let unit = scaled.map(|q| q / length);
        ((d[i - from] - Bounded::dot(d, unit) * unit[i - from]) / length / largest).error
    }
}

impl Values for Activations {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let count = self.raw.len() / WIDTH;
        let mut trial = Trial::new(device);
        let mut field = |start: usize, end: usize| {
            let rows = self.gradient.chunks(WIDTH).flat_map(|row| row[start..end].iter().copied());
            trial.input(&rows.collect::<Vec<_>>())
        };
        let [d_means, d_scales, d_quats, d_opacities, d_sh_coeffs] =
            [(0, 3), (3, 6), (6, 10), (10, 11), (11, WIDTH)].map(|(start, end)| field(start, end));
        let (raw, d_raw) = (trial.input(&self.raw), trial.output::<f32>(self.raw.len()));
        let kernel = ActivateBackward {
            raw,
            unit: trial.input(&[1.0f32]),
            d_means,
            d_scales,
            d_quats,
            d_opacities,
            d_sh_coeffs,
            d_raw,
            count: count as u32,
            bases: 1,
            group: 1,
            stride: WIDTH as u32,
        };
        trial.rec.dispatch(kernel, count);
        trial.result(d_raw)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let rows = self.raw.chunks(WIDTH).zip(self.gradient.chunks(WIDTH));
        let truth = rows.flat_map(|(raw, gradient)| activate_backward(&widen(raw), &widen(gradient))).collect();
        [truth, (0..self.raw.len()).map(|i| self.error(i)).collect()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (raw, d) = (|i: usize| f64::from(self.raw[i]), |i: usize| f64::from(self.gradient[i]));
        let quat = |i: usize| (i / WIDTH * WIDTH + 6)..(i / WIDTH * WIDTH + 10);
        let one = |i: usize| match (fault, i % WIDTH) {
            (Fault::HalfResult, _) => half(truth[i]),
            (Fault::NotActivated, _) => d(i),
            (Fault::NoClamp, 0..3) => d(i) * raw(i).abs().exp(),
            (Fault::AlongItself, 6..10) => d(i) / quat(i).map(|k| raw(k).powi(2)).sum::<f64>().sqrt(),
            (Fault::NeighborGaussian, _) => truth[(i + WIDTH) % truth.len()],
            _ => truth[i],
        };
        (0..truth.len()).map(one).collect()
    }
}

pub fn area() -> Area {
    use Fault::*;
    let all = [HalfResult, NotActivated, NoClamp, AlongItself, NeighborGaussian];
    let mut area = Area::new("gaussians/activate_backward", "Gaussians", Mode::ONLY_EXACT, REASON);
    for count in [64, 4097] {
        area.add("random of +-6", count, all, move || Activations::new(count, 6.0));
    }
    for length in [1e-20, 1e-13, 1e-11, 1e-6, 1e-3, 1.0, 1e3, 1e19, 1e30] {
        let name = format!("quaternions of length {length:e}");
        area.add(name, 65, [HalfResult, NotActivated], move || Activations::new(65, length));
    }
    area
}
