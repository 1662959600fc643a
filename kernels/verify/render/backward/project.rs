use super::{Vector, added_to, cross, minus, plus, times};
use crate::{
    prelude::*,
    render::forward::picture::{Seen, gaussians, reference_camera},
};
use glam::{DMat3, DVec3};
use zipsplat::{
    kernels::render::{CamerasBackward, ProjectBackward},
    stages::render::camera_rows,
    types::{Camera, Pose, Scene},
};
use zipsplat_reference::render::{
    backward::{OneGradient, of_splat},
    project::{EPS_2D, Gaussians, Splat, project},
};

const REASON: &str = "running error analysis of the kernel, formula by formula; the truth, of differences of fourth order in f64, is \
    allowed a thousandth of that, and 1e-7 of the longest of its row";

/// Center, standard deviations, quaternion, opacity.
const VALUES: usize = 11;
const CAMERA: usize = 10;

/// Gaussians before one camera, and splat gradients `[N, 10]`.
#[derive(Clone)]
struct Problem {
    scene: Scene,
    camera: Camera,
    antialiased: bool,
    pairs: Vec<[f32; 10]>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    Unwritten,
    HalfPairs,
    NoBlur,
    FixedShape,
    NoDepthOfShape,
    /// Center gradients beyond the clamped borders.
    Unheld,
    TurnInCamera,
    NotNormalized,
    LogOpacity,
    NoCompensation,
    NeighborGaussian,
}

struct Found {
    /// `[VALUES]`
    gaussian: Vec<Bounded>,
    /// `[CAMERA]`
    camera: Vec<Bounded>,
}

impl Problem {
    fn new(scene: Scene, camera: Camera, antialiased: bool) -> Self {
        let mut noise = Noise::new(scene.len() as u64);
        let mut pair = || {
            // Moments of a few pixels keep the second order consistent.
            let mut sums = [0.0; 10];
            for _ in 0..5 {
                let [g, e, y] = [1.0, 3.0, 3.0].map(|size| size * noise.uniform(-1.0, 1.0));
                let of = [g, g * e, g * y, g * e * e, g * e * y, g * y * y];
                (0..6).for_each(|i| sums[i] += of[i]);
            }
            (6..10).for_each(|i| sums[i] = 0.3 * noise.uniform(-1.0, 1.0));
            sums
        };
        let pairs = (0..scene.len()).map(|_| pair()).collect();
        Self { scene, camera, antialiased, pairs }
    }

    fn one(&self, n: usize) -> Gaussians {
        let all = gaussians(&self.scene);
        let coeffs = all.sh_coeffs.len() / all.means.len();
        Gaussians {
            means: vec![all.means[n]],
            quats: vec![all.quats[n]],
            scales: vec![all.scales[n]],
            opacities: vec![all.opacities[n]],
            sh_coeffs: all.sh_coeffs[n * coeffs..][..coeffs].to_vec(),
        }
    }

    fn conics(&self) -> Vec<[f64; 3]> {
        let splats = project(&gaussians(&self.scene), &reference_camera(&self.camera), self.antialiased);
        let conic = |splat: Option<Splat>| {
            let [xx, xy, yy] = splat.expect("a case whose Gaussians are all seen").conic;
            // xx yy - xy xy without cancellation.
            let determinant = xx * yy - xy * xy;
            [xx, -xy / xx, determinant / xx]
        };
        splats.into_iter().map(conic).collect()
    }

    /// Bounds render/project_backward.comp, formula by formula: the truth by differences lacks
    /// intermediate values.
    fn gradient(&self, n: usize, conic: [f64; 3], fault: Option<Fault>) -> Found {
        let is = |other: Fault| fault == Some(other);
        let zero = Bounded::exact(0.0);
        let [a, k, p_conic] = conic.map(Bounded::rounded);
        let half = |x: f32| if is(Fault::HalfPairs) { half(x.into()) } else { x.into() };
        let pair = self.pairs[n].map(|x| Bounded::exact(half(x)));
        let [g, ge, gy, gee, gey, gyy] = std::array::from_fn(|i| pair[i]);
        let rotation = self.camera.pose.rotation;
        let view = |r: usize, c: usize| Bounded::rounded(rotation.col(r)[c]);
        let Seen { p, focal, free, slope, axes: rows, along, .. } = Seen::new(&self.scene, n, &self.camera);
        let held = [0, 1].map(|axis| slope[axis].value != free[axis].value && !is(Fault::Unheld));
        let scale = self.scene.scales[n].map(Bounded::exact);
        let [u, v] = along.map(|along| [0, 1, 2].map(|c| along[c] * scale[c]));
        let blur = Bounded::rounded(if is(Fault::NoBlur) { 0.0 } else { EPS_2D });
        let minors = cross(u, v);
        let m = plus(cross(v, minors), times(blur, u)).map(|x| x / (Bounded::dot(v, v) + blur));
        let (ee, ey, yy) = (a * (a * gee), a * (p_conic * gey), p_conic * (p_conic * gyy));
        let mut d_u = plus(times(ee, m), times(ey, v));
        let mut d_v = minus(plus(times(ey, m), times(yy, v)), times(k, d_u));
        if self.antialiased && !is(Fault::NoCompensation) {
            let sharp = Bounded::dot(minors, minors);
            let [dual_u, dual_v] = [cross(v, minors), cross(minors, u)].map(|dual| dual.map(|x| x / sharp));
            let by = Bounded::rounded(EPS_2D) * g;
            let across = times(by * a, minus(dual_u, times(k, dual_v)));
            d_u = plus(d_u, across);
            d_v = plus(d_v, minus(times(by * p_conic, dual_v), times(k, across)));
        }
        let [d_x, d_y] = [(0, d_u), (1, d_v)]
            .map(|(axis, d): (usize, Vector)| [0, 1, 2].map(|c| focal[axis] / p[2] * scale[c] * d[c]));
        let d_z = minus(times(-slope[0], d_x), times(slope[1], d_y));
        let mut d_slope = [-Bounded::dot(rows[2], d_x), -Bounded::dot(rows[2], d_y)];
        let mut sizes = [Bounded::dot(u, d_u), Bounded::dot(v, d_v)];
        if is(Fault::FixedShape) {
            (d_slope, sizes) = ([zero; 2], [zero; 2]);
        }
        let turn: Vector = [
            Bounded::dot(rows[1], d_z) - Bounded::dot(rows[2], d_y),
            Bounded::dot(rows[2], d_x) - Bounded::dot(rows[0], d_z),
            Bounded::dot(rows[0], d_y) - Bounded::dot(rows[1], d_x),
        ];
        let along_center = a * ge;
        let d_center = [along_center, p_conic * gy - k * along_center];
        let d_free = [0, 1].map(|axis| focal[axis] * d_center[axis] + if held[axis] { zero } else { d_slope[axis] });
        let of_shape = if is(Fault::NoDepthOfShape) { zero } else { sizes[0] + sizes[1] };
        let inward = (-(d_free[0] * free[0] + d_free[1] * free[1]) - of_shape) / p[2];
        let d_p: Vector = [d_free[0] / p[2], d_free[1] / p[2], pair[9] + inward];
        let to_world = |d: Vector| -> Vector { [0, 1, 2].map(|c| Bounded::dot(d, [0, 1, 2].map(|r| view(r, c)))) };
        let d_offset = plus(to_world(d_p), [pair[6], pair[7], pair[8]]);
        let d_scale: Vector = [0, 1, 2].map(|c| along[0][c] * d_u[c] + along[1][c] * d_v[c]);
        let d_turn = if is(Fault::TurnInCamera) { turn } else { to_world(turn) };
        let d_quat = self.quat(n, d_turn, is(Fault::NotNormalized));
        let opacity = if is(Fault::LogOpacity) { g } else { g / Bounded::exact(self.scene.opacities[n]) };
        let d_limit = [0, 1].map(|axis| if held[axis] { d_slope[axis] } else { zero });
        let to_camera: Vector = [0, 1, 2].map(|r| Bounded::dot([0, 1, 2].map(|c| view(r, c)), d_offset));
        let camera_turn = plus(cross(p, d_p), turn);
        let lens =
            [0, 1].map(|axis| d_center[axis] * free[axis] + (sizes[axis] - d_limit[axis] * slope[axis]) / focal[axis]);
        let principal = [0, 1].map(|axis| d_center[axis] - d_limit[axis] / focal[axis]);
        let pose = [camera_turn, to_camera].concat().into_iter().map(|x| -x);
        Found {
            gaussian: [&d_offset[..], &d_scale, &d_quat, &[opacity]].concat(),
            camera: pose.chain(lens).chain(principal).collect(),
        }
    }

    fn quat(&self, n: usize, turn: Vector, as_unit: bool) -> [Bounded; 4] {
        let q = self.scene.quats[n].map(Bounded::exact);
        let largest = q.iter().fold(Bounded::exact(0.0), |most, q| {
            if q.value.abs() > most.value { Bounded::exact(q.value.abs()) } else { most }
        });
        let scaled = q.map(|q| q / largest);
        let size = Bounded::dot(scaled, scaled).sqrt() * largest;
        let [w, x, y, z] = q.map(|q| q / size);
        let by = if as_unit { Bounded::exact(2.0) } else { Bounded::exact(2.0) / size };
        let around = cross(turn, [x, y, z]);
        let [a, b, c] = [0, 1, 2].map(|i| w * turn[i] + around[i]);
        [-Bounded::dot(turn, [x, y, z]), a, b, c].map(|d| by * d)
    }

    fn all(&self, fault: Option<Fault>) -> Vec<Bounded> {
        let conics = self.conics();
        let found: Vec<Found> = (0..self.scene.len()).map(|n| self.gradient(n, conics[n], fault)).collect();
        let mut all: Vec<Bounded> = found.iter().flat_map(|found| found.gaussian.clone()).collect();
        for number in 0..CAMERA {
            let terms = || found.iter().map(|found| found.camera[number]);
            let magnitudes: f64 = terms().map(|term| term.value.abs() + term.error).sum();
            let error = terms().map(|term| term.error).sum::<f64>() + gamma(found.len()) * magnitudes;
            all.push(Bounded { value: terms().map(|term| term.value).sum(), error });
        }
        all
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let (mut trial, count) = (Trial::new(device), self.scene.len());
        let lanes = device.limits().subgroup_size as usize;
        let conics: Vec<[f32; 3]> = self.conics().iter().map(|conic| conic.map(|x| x as f32)).collect();
        let d = [3, 3, 4, 1].map(|width| added_to(&mut trial, width * count, 0.0));
        let rows = count.div_ceil(lanes);
        let parts = trial.output::<[f32; CAMERA]>(rows);
        let d_cameras = added_to(&mut trial, CAMERA, 0.0);
        let i = &self.camera.intrinsics;
        let kernel = ProjectBackward {
            means: trial.input(&self.scene.means),
            scales: trial.input(&self.scene.scales),
            quats: trial.input(&self.scene.quats),
            opacities: trial.input(&self.scene.opacities),
            cameras: trial.input(&[camera_rows(&self.camera)]),
            conics: trial.input(&conics),
            d_pairs: trial.input(&self.pairs),
            d_means: d[0],
            d_scales: d[1],
            d_quats: d[2],
            d_opacities: d[3],
            d_cameras: parts,
            gaussians: count as u32,
            first_group: 0,
            camera_count: 1,
            width: i.width,
            height: i.height,
            antialiased: self.antialiased,
            scene_gradients: true,
            camera_gradients: true,
        };
        trial.rec.dispatch(kernel, count);
        let kernel = CamerasBackward { parts, d_cameras, rows: rows as u32, numbers: CAMERA as u32 };
        trial.rec.dispatch_groups(kernel, CAMERA);
        let [means, scales, quats, opacities, cameras] = trial.results([d[0], d[1], d[2], d[3], d_cameras])?;
        Ok([joined(&[means, scales, quats, opacities], [3, 3, 4, 1]), cameras].concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let camera = reference_camera(&self.camera);
        let one = |n: usize| of_splat(&self.one(n), &camera, self.antialiased, &self.pairs[n].map(f64::from));
        let found: Vec<OneGradient> = (0..self.scene.len()).map(one).collect();
        let row = |g: &OneGradient| [&g.mean[..], &g.scale, &g.quat, &[g.opacity]].concat();
        let mut truth: Vec<f64> = found.iter().flat_map(row).collect();
        truth.extend((0..CAMERA).map(|number| found.iter().map(|g| g.camera[number]).sum::<f64>()));
        let mut bounds: Vec<f64> = self.all(None).iter().map(|bounded| bounded.error).collect();
        let widths = (0..self.scene.len()).flat_map(|_| [3, 3, 4, 1]).chain([3, 3, 4]);
        let mut first = 0;
        for width in widths {
            let row = first..first + width;
            let longest = truth[row.clone()].iter().fold(0.0, |most: f64, value| most.max(value.abs()));
            bounds[row].iter_mut().for_each(|bound| *bound += 1e-3 * *bound + 1e-7 * longest);
            first += width;
        }
        [truth, bounds]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        match fault {
            Fault::Unwritten => vec![f64::NAN; truth.len()],
            Fault::NeighborGaussian => shifted(truth, VALUES),
            _ => self.all(Some(fault)).iter().map(|bounded| bounded.value).collect(),
        }
    }
}

fn scene(count: usize, change: impl Fn(usize, &mut [f32; 3], &mut [f32; 3])) -> Scene {
    let mut scene = Noise::new(count as u64 + 3).scene(count, 0);
    for i in 0..count {
        scene.opacities[i] = 0.2 + 0.7 * scene.opacities[i];
        // Keeps centers in the picture, which is wider than high.
        scene.means[i][1] *= 0.7;
        change(i, &mut scene.means[i], &mut scene.scales[i]);
    }
    scene
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("render/project_backward", "Gaussians", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, (scene, camera): (Scene, Camera), antialiased: bool| {
        let problem = Problem::new(scene, camera, antialiased);
        area.add(name, problem.scene.len(), catches, move || problem.clone());
    };
    let still = || camera(70, 53);
    let keep = |_: usize, _: &mut [f32; 3], _: &mut [f32; 3]| ();
    let seen = || Catches::from([HalfPairs, FixedShape, NoDepthOfShape, NotNormalized, LogOpacity, NeighborGaussian]);
    add("random", seen().and(&[NoBlur]), (scene(100, keep), still()), false);
    add("random, antialiased", seen().and(&[NoCompensation]), (scene(100, keep), still()), true);
    let turned = Pose {
        rotation: DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.1),
        translation: DVec3::new(3.0, -1.0, 2.0),
    };
    for (name, away) in [("a turned camera", 0.0), ("scene and camera 1e4 off", 1e4)] {
        let pose = Pose { translation: turned.translation + DVec3::new(away, -0.5 * away, 0.25 * away), ..turned };
        let mut moved = scene(50, |i, mean, _| *mean = mean.map(|x| x * (1.0 + i as f32 / 50.0)));
        for mean in &mut moved.means {
            *mean = pose.transform(DVec3::from(mean.map(f64::from))).as_vec3().to_array();
        }
        add(name, seen().and(&[TurnInCamera]), (moved, Camera { pose, ..still() }), false);
    }
    let needles = |_: usize, _: &mut [f32; 3], s: &mut [f32; 3]| *s = [1e-6, 1e-3, 2.0];
    add("needles", seen().and(&[NoBlur]), (scene(60, needles), still()), false);
    let needles = |_: usize, _: &mut [f32; 3], s: &mut [f32; 3]| *s = [0.02, 0.01, 1.0];
    add("needles, antialiased", seen().and(&[NoCompensation]), (scene(60, needles), still()), true);
    let points = |_: usize, _: &mut [f32; 3], s: &mut [f32; 3]| *s = [0.0; 3];
    add("points", [LogOpacity, NeighborGaussian].into(), (scene(60, points), still()), false);
    let near = scene(40, |i, m, s| {
        let z = 0.0101 + 1e-4 * i as f32;
        (*m, *s) = ([m[0] / m[2] * z, m[1] / m[2] * z, z], [1e-3, 5e-4, 2e-3]);
    });
    add("before the near plane", seen(), (near, still()), false);
    // Slopes are clamped beyond the borders, where large splats remain visible.
    let beyond = scene(40, |i, m, s| {
        let side = if i % 2 == 0 { 0.9 } else { -0.9 };
        (m[0], m[1], *s) = (side * m[2], 0.1 * m[1], [0.5 * m[2], 0.2 * m[2], 0.3 * m[2]]);
    });
    add("beyond the borders", seen().and(&[Unheld]), (beyond, still()), false);
    let over = scene(5, |i, m, s| (*m, *s) = ([0.0, 0.01, 0.1 * (i + 1) as f32], [2.0, 3.0, 1.0]));
    add("camera inside", [HalfPairs, FixedShape, LogOpacity].into(), (over, still()), false);
    for length in [1e-20, 1e20] {
        let mut stretched = scene(30, keep);
        stretched.quats.iter_mut().flatten().for_each(|q| *q *= length);
        let catches = [FixedShape, LogOpacity].into();
        add(&format!("rotations of length {length:e}"), catches, (stretched, still()), false);
    }
    let mut none = Problem::new(scene(65, keep), still(), false);
    none.pairs.fill([0.0; 10]);
    area.add("nothing visible", 65, [Fault::Unwritten], move || none.clone());
    area
}
