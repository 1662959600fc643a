use crate::prelude::*;
use zipsplat::stages::{gaussians, render::SceneTensors};
use zipsplat_reference::{
    gaussians::activate::activate,
    ops::activation::{sigmoid, softplus},
};

const REASON: &str = "each activation's slope times the rounding of its argument, plus Vulkan's limits for exp (3 + 2|x| units), log \
    (2^-21 near 1) and division; series by their first term left out; clamped values exactly";

/// Values of a raw Gaussian with band 0.
const WIDTH: usize = 14;

/// Raw Gaussians `[_, 11 + 3 (degree + 1)^2]`.
struct Problem {
    raw: Vec<f32>,
    degree: u32,
}

impl Problem {
    fn new(count: usize, degree: u32, value: impl Fn(usize, f32) -> f32) -> Self {
        let noise = Noise::new(6).values(count * width(degree)).into_iter().enumerate();
        Self { raw: noise.map(|(i, r)| value(i, r)).collect(), degree }
    }
}

fn width(degree: u32) -> usize {
    11 + 3 * (degree as usize + 1).pow(2)
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    HalfResult,
    NoClamp,
    /// exp(x) - 1 in f32.
    CancellingExp,
    NoOffset,
    /// log(1 + exp(x)) in f32.
    CancellingLog,
    NotNormalized,
    /// f32 squares, which overflow and underflow.
    SquaresOfF32,
    DividedByLength,
    NoSigmoid,
    NeighborGaussian,
}

impl Fault {
    /// Value `c` of a raw Gaussian.
    fn apply(self, raw: &[f64], c: usize, right: f64) -> f64 {
        let x = raw[c];
        let single = |x: f64| x as f32;
        match (self, c) {
            (Fault::HalfResult, _) => half(right),
            (Fault::NoClamp, 0..3) => x.signum() * x.abs().exp_m1(),
            (Fault::CancellingExp, 0..3) => x.signum() * f64::from(single(x.abs().min(5.0)).exp() - 1.0),
            (Fault::NoOffset, 3..6) => softplus(x).clamp(1e-6, 15.0),
            (Fault::CancellingLog, 3..6) => f64::from((1.0 + single(x - 4.0).exp()).ln()).clamp(1e-6, 15.0),
            (Fault::NotNormalized, 6..10) => x,
            (Fault::SquaresOfF32, 6..10) => {
                let squares: f32 = raw[6..10].iter().map(|&q| single(q) * single(q)).sum();
                x / f64::from(squares.sqrt().max(1e-12))
            }
            (Fault::DividedByLength, 6..10) => x / raw[6..10].iter().map(|q| q * q).sum::<f64>().sqrt(),
            (Fault::NoSigmoid, 10) => x,
            _ => right,
        }
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        run(device, &self.raw, self.degree, 1.0)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let raw = widen(&self.raw);
        let truth: Vec<f64> = raw.chunks(width(self.degree)).flat_map(activate).collect();
        let bound = |(i, truth): (usize, &f64)| match i % width(self.degree) {
            0..3 => mean_error(raw[i].abs().min(5.0)),
            3..6 => scale_error(raw[i]) + U * truth,
            c @ 6..10 => quat_error(*truth, raw[i + 6 - c..][..4].iter().map(|x| x * x).sum::<f64>().sqrt()),
            10 => opacity_error(raw[i]),
            _ => 0.0,
        };
        let bounds = truth.iter().enumerate().map(bound).collect();
        [truth, bounds]
    }

    fn typical(&self, _: Mode) -> Tolerance {
        Tolerance::EXPONENTIAL
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (raw, width) = (widen(&self.raw), width(self.degree));
        let one = |i: usize| fault.apply(&raw[i / width * width..][..width], i % width, truth[i]);
        match fault {
            Fault::NeighborGaussian => shifted(truth, width),
            _ => (0..truth.len()).map(one).collect(),
        }
    }
}

pub fn run(device: &Device, raw: &[f32], degree: u32, scale: f32) -> Result<Vec<f32>> {
    let count = raw.len() / width(degree);
    let mut trial = Trial::new(device);
    let input = trial.input(raw);
    let unit = trial.input(&[scale]);
    let scene = SceneTensors::output(&mut trial.rec, count, degree);
    gaussians::activate(&mut trial.rec, input, unit, &scene);
    let SceneTensors { means, scales, quats, opacities, sh_coeffs, .. } = scene;
    let fields = trial.results([means, scales, quats, opacities, sh_coeffs])?;
    Ok(joined(&fields, [3, 3, 4, 1, width(degree) - 11]))
}

/// expm1 at `x >= 0`. Below 0.35: a series to x^7 / 5040; above: exp(x) - 1.
fn mean_error(x: f64) -> f64 {
    let series = x.powi(7) / 5040.0 * 1.1 + gamma(14) * x.exp_m1();
    let difference = x.exp() * exponential(x) + U * x.exp_m1();
    TINY + if x < 0.35 { series } else { difference }
}

/// softplus(x - 4) before its clamps.
fn scale_error(x: f64) -> f64 {
    let z = x - 4.0;
    if z > 20.0 {
        return U * z;
    }
    let u = z.exp();
    let carried = sigmoid(z) * (U * z.abs() + exponential(z));
    // Series of 2 atanh(u / (2 + u)), truncated below 1e-8.
    let series = softplus(z) * (1e-8 + DIVISION + gamma(12));
    let direct = U + logarithm(1.0 + u);
    TINY + carried + if u < 0.5 { series } else { direct }
}

/// A division by the largest component, then by the length.
fn quat_error(component: f64, length: f64) -> f64 {
    // Short quaternions are divided by 1e-12, which amplifies flushed values.
    let flushed = if length < 2e-12 { TINY * 1e12 } else { TINY };
    component.abs() * (2.0 * DIVISION + ROOT + gamma(6)) + 4.0 * flushed
}

fn opacity_error(x: f64) -> f64 {
    let opacity = sigmoid(x);
    opacity * ((1.0 - opacity) * exponential(x) + U + DIVISION) + TINY
}

/// Bit-equal on every device.
struct Clamps;

/// Mean (bits by the device), scale, opacity.
#[derive(Clone)]
struct Ends {
    means: Vec<[u32; 2]>,
    scales: Vec<[u32; 2]>,
    opacities: Vec<u32>,
}

#[derive(Clone, Copy, Debug)]
enum ClampFault {
    MeanPassed,
    LargeScalePassed,
    SmallScalePassed,
    Uneven,
    OpacityBelow,
}

impl case::Problem for Clamps {
    type Output = Ends;
    type Truth = Ends;
    type Fault = ClampFault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Ends> {
        let mut raw = vec![0.0f32; 4 * WIDTH];
        for (row, x) in raw.chunks_mut(WIDTH).zip([5.0, 7.0, 1e30, f32::MAX]) {
            row[..3].fill(x);
            row[3..6].copy_from_slice(&[19.5 + x, 1e30, f32::MAX]);
            row[6] = 1.0;
            row[10] = 100.0 + x;
        }
        let high = run(device, &raw, 0, 1.0)?;
        raw.iter_mut().for_each(|x| *x = -*x);
        let low = run(device, &raw, 0, 1.0)?;
        let rows = || high.chunks(WIDTH).zip(low.chunks(WIDTH));
        let ends = |range: std::ops::Range<usize>| -> Vec<[u32; 2]> {
            rows()
                .flat_map(|(h, l)| range.clone().map(|c| [h[c].to_bits(), l[c].to_bits()]).collect::<Vec<_>>())
                .collect()
        };
        let opacities = rows().map(|(high, _)| high[10].to_bits()).collect();
        Ok(Ends { means: ends(0..3), scales: ends(3..6), opacities })
    }

    fn truth(&self, _: Mode) -> Ends {
        let mean = 5.0f64.exp_m1() as f32;
        let means = vec![[mean, -mean].map(f32::to_bits); 12];
        Ends { means, scales: vec![[15.0f32, 1e-6].map(f32::to_bits); 12], opacities: vec![1.0f32.to_bits(); 4] }
    }

    fn judge(&self, truth: &Ends, output: &Ends, _: Mode) -> Worst {
        let mean = f64::from(f32::from_bits(output.means[0][0]));
        let negative = (-mean as f32).to_bits();
        Worst::one(mean, 5.0f64.exp_m1(), mean_error(5.0))
            .or(Worst::differing(&output.means, &vec![[output.means[0][0], negative]; output.means.len()]))
            .or(Worst::differing(&output.scales, &truth.scales))
            .or(Worst::differing(&output.opacities, &truth.opacities))
    }

    fn faulty(&self, truth: &Ends, fault: ClampFault, _: Mode) -> Vec<Ends> {
        let mut ends = truth.clone();
        match fault {
            ClampFault::MeanPassed => ends.means[3][0] = 7.0f32.exp_m1().to_bits(),
            ClampFault::LargeScalePassed => ends.scales[0][0] = 15.5f32.to_bits(),
            ClampFault::SmallScalePassed => ends.scales[0][1] = 0,
            ClampFault::Uneven => ends.means.iter_mut().for_each(|mean| mean[1] += 1),
            ClampFault::OpacityBelow => ends.opacities[0] -= 1,
        }
        vec![ends]
    }
}

pub fn shapes() -> Area {
    use Fault::*;
    let mut area = Area { cases: Vec::new(), ..area() };
    for degree in [0, 1, 2, 3] {
        let make = move || [0, 1, 63, 64, 65, 333].map(|count| Problem::new(count, degree, |_, r| 6.0 * r)).into();
        let name = format!("random of +-6, degree {degree}");
        area.sweep(name, 333, [HalfResult, NoOffset, NotNormalized], make);
    }
    area
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("gaussians/activate", "Gaussians", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, count: usize, catches: Catches<Fault>, value: fn(usize, f32) -> f32| {
        area.add(name, count, catches, move || Problem::new(count, 0, value));
    };
    let all = || Catches::from([HalfResult, NoOffset, NotNormalized, NoSigmoid]);
    add("random of +-6", 1, all(), |_, r| 6.0 * r);
    for count in [64, 4097] {
        add("random of +-6", count, all().and(&[NoClamp, CancellingLog, NeighborGaussian]), |_, r| 6.0 * r);
    }
    add("every value from -100 to 100", 20_001, all().and(&[NoClamp, CancellingExp, CancellingLog]), |i, r| {
        if (6..10).contains(&(i % WIDTH)) { r } else { (i / WIDTH) as f32 / 100.0 - 100.0 }
    });
    let near = [HalfResult, CancellingExp];
    add("means near 0, where exp(x) - 1 cancels", 400, near.into(), |i, _| 0.5f32.powi((i / WIDTH) as i32 / 2));
    for length in [0.0, 1e-30, 1e-20, 1e-13, 1e-12, 1e-11, 1e-6, 1e-3, 1e3, 1e19, 1e20, 1e37] {
        let catches = match length {
            0.0 => Catches::from([DividedByLength]),
            1e20.. => Catches::from([HalfResult, NotNormalized, SquaresOfF32]),
            _ => Catches::from([HalfResult, NotNormalized]),
        };
        let value = move |i: usize, r: f32| if (6..10).contains(&(i % WIDTH)) { length * r } else { r };
        area.add(format!("quaternions of length {length:e}"), 65, catches, move || Problem::new(65, 0, value));
    }
    use ClampFault::*;
    let clamps = [MeanPassed, LargeScalePassed, SmallScalePassed, Uneven, OpacityBelow];
    area.add("clamps and saturation", 4, clamps, || Clamps);
    area
}
