use crate::case::*;
use zipsplat::kernels::lpips::Compare;
use zipsplat_tests::reference::lpips::compare::compare;

struct Features {
    a: Vec<f32>,
    b: Vec<f32>,
    weights: Vec<f32>,
}

impl Features {
    fn new(pixels: usize, channels: usize) -> Self {
        let mut a = random(1, pixels * channels);
        let mut b = random(2, pixels * channels);
        a[channels..2 * channels].iter_mut().for_each(|x| *x = -x.abs());
        b[2 * channels..3 * channels].iter_mut().for_each(|x| *x = -x.abs());
        Self { a, b, weights: random(3, channels).iter().map(|x| x.abs()).collect() }
    }

    /// Sums, and the gradient added to `before`.
    fn compared(&self, before: Option<&[f32]>, scale: f32) -> [Vec<f32>; 2] {
        let (channels, pixels) = (self.weights.len(), self.a.len() / self.weights.len());
        let mut case = plan();
        let d_a = match before {
            Some(before) => case.input(before),
            None => case.output::<f32>(self.a.len()),
        };
        let kernel = Compare {
            a: case.input(&self.a),
            b: case.input(&self.b),
            weights: case.input(&self.weights),
            sums: case.output::<f32>(pixels),
            d_a,
            pixels: pixels as u32,
            channels: channels as u32,
            scale,
            gradient: true,
            add: before.is_some(),
        };
        case.rec.dispatch_groups(kernel, pixels);
        case.results([kernel.sums, d_a]).unwrap()
    }

    fn truth(&self, a: &[f64]) -> Vec<f64> {
        let rectified = |values: Vec<f64>| values.into_iter().map(|x| x.max(0.0)).collect::<Vec<_>>();
        compare(&rectified(a.to_vec()), &rectified(widen(&self.b)), &self.weights)
    }
}

#[test]
fn equals_the_reference() {
    for (pixels, channels) in [(3, 1), (5, 64), (9, 100), (4, 512)] {
        let features = Features::new(pixels, channels);
        let [sums, _] = features.compared(None, 0.5);
        let truth: Vec<f64> = features.truth(&widen(&features.a)).iter().map(|x| 0.5 * x).collect();
        assert_close(&format!("{channels} channels"), &sums, &truth, Tolerance { max: 1e-6, rms: 1e-6 });
    }
}

#[test]
fn the_gradient_is_the_slope() {
    for (pixels, channels) in [(5, 64), (4, 300)] {
        let features = Features::new(pixels, channels);
        let before = random(5, features.a.len());
        let [_, alone] = features.compared(None, 2.0);
        let [_, added] = features.compared(Some(&before), 2.0);
        let direction = widen(&random(4, features.a.len()));
        let a = widen(&features.a);
        for pixel in 0..pixels {
            let own = pixel * channels..(pixel + 1) * channels;
            // Features at or below 0 stay: the rectifier stops their gradient later.
            let step = 1e-6;
            let moved = |sign: f64| {
                let mut a = a.clone();
                own.clone().filter(|&i| a[i] > step).collect::<Vec<_>>().into_iter().for_each(|i| {
                    a[i] += sign * step * direction[i];
                });
                features.truth(&a)[pixel]
            };
            let slope = 2.0 * (moved(1.0) - moved(-1.0)) / (2.0 * step);
            let along: f64 = own.clone().filter(|&i| a[i] > step).map(|i| f64::from(alone[i]) * direction[i]).sum();
            assert!((along - slope).abs() < 1e-5 * (1.0 + slope.abs()), "pixel {pixel}: {along}, slope {slope}");
            for i in own {
                assert!((added[i] - before[i] - alone[i]).abs() < 1e-6 * (1.0 + alone[i].abs()), "added at {i}");
            }
        }
    }
}
