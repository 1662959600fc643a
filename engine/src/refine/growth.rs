//! Source: 3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024). Plans fix
//! the number of Gaussians: all exist from the start and become alive over time.

use super::checkpoint::State;
use crate::{
    Result,
    random::Random,
    types::{Scene, matrix_from_quaternion},
};
use glam::{DMat3, DVec3};

const DEAD: f32 = 0.005;
pub(super) const INVISIBLE: f32 = 1.0 / 255.0;
const MAX_COPIES: usize = 51;
/// Fractions of the steps: end of growth, and of relocation.
pub(super) const GROWTH_END: f64 = 0.5;
const RELOCATION_END: f64 = 0.8;

pub(super) struct Growth {
    random: Random,
    counts: [usize; 2],
}

impl Growth {
    pub fn new(first: usize, most: usize, seed: u64) -> Self {
        Self { random: Random::new(!seed), counts: [first, most.max(first)] }
    }

    pub fn state(&mut self, state: &mut State<'_>) -> Result<()> {
        state.fixed("growth.random", std::slice::from_mut(self.random.state()))
    }

    pub fn is_due(along: f64) -> bool {
        along <= RELOCATION_END
    }

    /// `along` is the completed fraction of the steps, `rate` the fraction of the initial rate,
    /// `gradients` the root mean squares of the means' gradients. Returns the changed Gaussians.
    pub fn apply(&mut self, scene: &mut Scene, gradients: &[f64], along: f64, rate: f32) -> Vec<usize> {
        self.add_noise(scene, f64::from(rate));
        let (live, dead): (Vec<usize>, Vec<usize>) = (0..scene.len()).partition(|i| scene.opacities[*i] > DEAD);
        let [first, most] = self.counts.map(|count| count as f64);
        let wanted = (first * (most / first).powf((along / GROWTH_END).min(1.0))).round() as usize;
        let chosen = self.choose(scene, gradients, &live, dead.len().min(wanted.saturating_sub(live.len())));
        let mut dead = dead.into_iter();
        let mut changed = Vec::new();
        for same in chosen.chunk_by(|a, b| a == b) {
            let source = same[0];
            let spread = self.split(scene, source, (same.len() + 1).min(MAX_COPIES));
            let mean = DVec3::from(scene.means[source].map(f64::from));
            changed.push(source);
            for to in dead.by_ref().take(same.len()) {
                copy(scene, source, to);
                let offset = spread * DVec3::from([(); 3].map(|()| self.random.normal()));
                scene.means[to] = (mean + offset).as_vec3().to_array();
                changed.push(to);
            }
        }
        changed
    }

    /// Samples by opacity, as in the paper, times gradient, which persists where detail is missing.
    fn choose(&mut self, scene: &Scene, gradients: &[f64], live: &[usize], count: usize) -> Vec<usize> {
        let mut sum = 0.0;
        let add = |i: &usize| {
            sum += f64::from(scene.opacities[*i]) * gradients[*i];
            sum
        };
        let sums: Vec<f64> = live.iter().map(add).collect();
        let Some(total) = sums.last().filter(|total| **total > 0.0) else { return Vec::new() };
        let mut draw = || {
            let drawn = self.random.unit() * total;
            live[sums.partition_point(|sum| *sum <= drawn).min(live.len() - 1)]
        };
        let mut chosen: Vec<usize> = (0..count).map(|_| draw()).collect();
        chosen.sort_unstable();
        chosen
    }

    /// Returns the transform from normal samples to offsets with the Gaussian's former spread.
    fn split(&self, scene: &mut Scene, i: usize, count: usize) -> DMat3 {
        let was = axes(scene, i);
        let (opacity, size) = split_opacity(f64::from(scene.opacities[i]), count);
        scene.opacities[i] = (opacity as f32).max(DEAD);
        scene.scales[i] = scene.scales[i].map(|scale| (f64::from(scale) * size) as f32);
        was
    }

    fn add_noise(&mut self, scene: &mut Scene, rate: f64) {
        for i in 0..scene.len() {
            let opacity = f64::from(scene.opacities[i]);
            // As in 3DGS-MCMC: one half for dead Gaussians, almost 0 from opacity 0.1.
            let free = 1.0 / (1.0 + (100.0 * (opacity - f64::from(DEAD))).exp());
            if free > 1e-3 && opacity > f64::from(INVISIBLE) {
                let normal = DVec3::from([(); 3].map(|()| self.random.normal()));
                let mean = DVec3::from(scene.means[i].map(f64::from)) + rate * free * (axes(scene, i) * normal);
                scene.means[i] = mean.as_vec3().to_array();
            }
        }
    }
}

fn axes(scene: &Scene, i: usize) -> DMat3 {
    let scales = DVec3::from(scene.scales[i].map(f64::from));
    matrix_from_quaternion(scene.quats[i].map(f64::from)) * DMat3::from_diagonal(scales)
}

fn copy(scene: &mut Scene, from: usize, to: usize) {
    scene.means[to] = scene.means[from];
    scene.scales[to] = scene.scales[from];
    scene.quats[to] = scene.quats[from];
    scene.opacities[to] = scene.opacities[from];
    let width = scene.sh_coeffs_per_gaussian();
    scene.sh_coeffs.copy_within(from * width..(from + 1) * width, to * width);
}

/// Returns the opacity of each of `count` coincident Gaussians as opaque as one, and their relative
/// size (equation 9 of the paper).
fn split_opacity(opacity: f64, count: usize) -> (f64, f64) {
    let each = 1.0 - (1.0 - opacity).powf(1.0 / count as f64);
    // Binomials of count over k + 1, times each^(k + 1), with alternating signs.
    let (mut term, mut sum) = (-1.0, 0.0);
    for k in 0..count {
        term *= -each * (count - k) as f64 / (k + 1) as f64;
        sum += term / ((k + 1) as f64).sqrt();
    }
    (each, opacity / sum)
}

pub(super) fn padded(scene: &Scene, most: usize) -> Scene {
    let (mut padded, first) = (scene.clone(), scene.len());
    let most = most.max(first);
    let coeffs = &scene.sh_coeffs[..scene.sh_coeffs_per_gaussian()];
    padded.means.resize(most, scene.means[0]);
    padded.scales.resize(most, scene.scales[0]);
    padded.quats.resize(most, scene.quats[0]);
    padded.opacities.resize(most, 0.0);
    padded.sh_coeffs.extend((first..most).flat_map(|_| coeffs));
    padded
}

pub(super) fn drop_invisible(scene: &mut Scene) {
    let seen: Vec<usize> = (0..scene.len()).filter(|i| scene.opacities[*i] >= INVISIBLE).collect();
    // A scene needs a Gaussian.
    if !seen.is_empty() {
        scene.keep(&seen);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(count: usize) -> Scene {
        Scene {
            means: (0..count).map(|i| [i as f32, 0.0, 3.0]).collect(),
            scales: vec![[0.1, 0.2, 0.3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacities: (0..count).map(|i| if i % 2 == 0 { 0.8 } else { 0.2 }).collect(),
            sh_coeffs: (0..4 * count).map(|i| [i as f32; 3]).collect(),
            sh_degree: 1,
            antialiased: false,
        }
    }

    #[test]
    fn a_scene_keeps_gaussians_even_if_all_are_invisible() {
        let faint = Scene { opacities: vec![0.0; 3], ..scene(3) };
        let mut kept = faint.clone();
        drop_invisible(&mut kept);
        assert!(kept == faint);
    }

    #[test]
    fn shares_hide_what_one_hid() {
        for (opacity, count) in [(0.9, 2), (0.5, 3), (0.99, 10), (0.1, 51)] {
            let (each, size) = split_opacity(opacity, count);
            assert!((1.0 - (1.0 - each).powi(count as i32) - opacity).abs() < 1e-12);
            let hidden = |opacity: f64, size: f64, count: i32| {
                let at = |x: f64| 1.0 - (1.0 - opacity * (-0.5 * (x / size).powi(2)).exp()).powi(count);
                (-8000..8000).map(|i| at(f64::from(i) * 1e-3) * 1e-3).sum::<f64>()
            };
            let (one, all) = (hidden(opacity, 1.0, 1), hidden(each, size, count as i32));
            assert!((one - all).abs() < 1e-4 * one, "{opacity} in {count}: {one} and {all}");
        }
        assert_eq!(split_opacity(0.7, 1), (1.0 - (1.0f64 - 0.7), 1.0));
    }

    #[test]
    fn dead_gaussians_come_alive_where_others_are() {
        let start = scene(8);
        assert!(Growth::is_due(0.8) && !Growth::is_due(0.81));
        let mut growth = Growth::new(8, 32, 1);
        let (mut grown, even) = (padded(&start, 32), [1.0; 32]);
        let live = |scene: &Scene| scene.opacities.iter().filter(|opacity| **opacity > DEAD).count();
        assert_eq!((grown.len(), live(&grown)), (32, 8));
        let changed = growth.apply(&mut grown, &even, 0.25, 0.0);
        assert_eq!(live(&grown), 16);
        assert!((8..16).all(|i| changed.contains(&i)) && grown.means[16..] == padded(&start, 32).means[16..]);
        for i in 8..16 {
            let source = (grown.sh_coeffs[4 * i][0] / 4.0) as usize;
            assert!(changed.contains(&source) && grown.opacities[i] == grown.opacities[source]);
            assert!(grown.opacities[source] < start.opacities[source]);
            let offset = grown.means[i][0] - start.means[source][0];
            assert!(offset.abs() < 0.5, "{offset} from {source}");
        }
        growth.apply(&mut grown, &even, 0.5, 0.0);
        assert_eq!(live(&grown), 32);
        grown.validate().expect("a valid scene");
        let mut again = padded(&start, 32);
        let mut growth = Growth::new(8, 32, 1);
        growth.apply(&mut again, &even, 0.25, 0.0);
        growth.apply(&mut again, &even, 0.5, 0.0);
        assert_eq!(again, grown);
        grown.opacities[3] = 0.001;
        drop_invisible(&mut grown);
        assert_eq!(grown.len(), 31);
    }

    #[test]
    fn gaussians_with_large_gradients_are_split() {
        let mut grown = padded(&scene(8), 32);
        let mut gradients = [0.0; 32];
        assert!(Growth::new(8, 32, 1).apply(&mut grown, &gradients, 0.25, 0.0).is_empty());
        gradients[3] = 1.0;
        let changed = Growth::new(8, 32, 1).apply(&mut grown, &gradients, 0.25, 0.0);
        assert_eq!((changed.len(), changed[0]), (9, 3));
    }

    #[test]
    fn what_is_nearly_transparent_wanders() {
        let (mut moved, still) = (scene(4), scene(4));
        moved.opacities[2] = 0.005;
        Growth::new(4, 4, 0).add_noise(&mut moved, 1.0);
        let distance =
            |i: usize| DVec3::from(moved.means[i].map(f64::from)).distance(still.means[i].map(f64::from).into());
        assert!([0, 1, 3].iter().all(|i| distance(*i) == 0.0) && (1e-3..1.0).contains(&distance(2)), "{}", distance(2));
    }
}
