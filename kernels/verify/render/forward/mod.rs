mod faults;
pub mod picture;

use crate::prelude::*;
use faults::{Fault, Picture, wrong};
use glam::{DMat3, DVec3};
use picture::{PixelBounds, bounds, orders_depths, truth};
use zipsplat::{
    stages::render::{Depth, RenderOptions, Renderer},
    types::{Camera, NEAR, Pose, Scene},
};
use zipsplat_reference::render::rasterize::Rendering;

const REASON: &str = "running error analysis (Wilkinson) of projection and blending, formula by formula: every value carries what \
    rounding may have added; where alpha may lie on either side of 1/255, or transmittance of 1e-4, both pictures are allowed";

#[derive(Clone)]
struct Problem {
    scene: Scene,
    camera: Camera,
    antialiased: bool,
    /// Camera and number of preceding pictures in the batch.
    before: Option<(Camera, usize)>,
}

impl case::Problem for Problem {
    type Output = Picture;
    type Truth = (Rendering, Vec<PixelBounds>);
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Picture> {
        let antialiased = self.antialiased;
        let request = RenderOptions {
            alpha: true,
            depth: Some(Depth::Accumulated),
            antialiased: Some(antialiased),
            near: Some(NEAR),
            ..RenderOptions::default()
        };
        let mut cameras = self.before.map_or(Vec::new(), |(camera, count)| vec![camera; count]);
        cameras.push(self.camera);
        let mut frames = Renderer::new(device).render_scene(&self.scene, &cameras, &request)?;
        let planes = frames.pop().map(|frame| [frame.rgb, frame.alpha, frame.depth]);
        Ok(planes.unwrap_or_default().map(Option::unwrap_or_default))
    }

    fn truth(&self, _: Mode) -> Self::Truth {
        assert!(orders_depths(&self.scene, &self.camera), "a case whose order of depths f32 decides");
        let picture = truth(&self.scene, &self.camera, self.antialiased);
        (picture, bounds(&self.scene, &self.camera, self.antialiased))
    }

    fn judge(&self, (truth, bounds): &Self::Truth, [rgb, alpha, depth]: &Picture, _: Mode) -> Worst {
        // The truth itself rounds in f64 and blends by another formula.
        let slack = |truth: f64| U * 1e-3 * truth.abs();
        let rgb = Worst::of(rgb, &truth.rgb, |i| bounds[i / 3][i % 3] + slack(truth.rgb[i]));
        let alpha = Worst::of(alpha, &truth.alpha, |i| bounds[i][3] + slack(1.0));
        let depth = Worst::of(depth, &truth.depth, |i| bounds[i][4] + slack(truth.depth[i]));
        rgb.or(alpha).or(depth)
    }

    fn faulty(&self, _: &Self::Truth, fault: Fault, _: Mode) -> Vec<Picture> {
        let before = self.before.as_ref().map(|(camera, _)| camera);
        vec![wrong(&self.scene, &self.camera, self.antialiased, fault, before)]
    }
}

fn scene(count: usize, degree: u32, change: impl Fn(usize, &mut [f32; 3], &mut [f32; 3], &mut f32)) -> Scene {
    let mut scene = Noise::new(count as u64 + 1).scene(count, degree);
    for i in 0..count {
        change(i, &mut scene.means[i], &mut scene.scales[i], &mut scene.opacities[i]);
    }
    scene
}

fn turned(mut scene: Scene, pose: Pose) -> (Scene, Camera) {
    for mean in &mut scene.means {
        *mean = pose.transform(DVec3::from(mean.map(f64::from))).as_vec3().to_array();
    }
    (scene, Camera { pose, ..camera(70, 53) })
}

fn needles_off(count: usize, distance: f64) -> Scene {
    let mut scene = scene(count, 0, |i, mean, scales, _| {
        let along = DVec3::from_array([(i as f64).cos(), (i as f64).sin(), 0.0]);
        let (depth, f) = (1.0 + 0.1 * i as f64, 70.0);
        let seen = DVec3::from(mean.map(f64::from)) / f64::from(mean[2]);
        *mean = ((seen + distance / f * along) * depth).as_vec3().to_array();
        *scales = [(distance / f * depth) as f32, 1e-3, 2e-3];
    });
    for (i, quat) in scene.quats.iter_mut().enumerate() {
        *quat = [(0.5 * i as f32).cos(), 0.0, 0.0, (0.5 * i as f32).sin()];
    }
    scene
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("render", "Gaussians", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, (scene, camera): (Scene, Camera), antialiased: bool| {
        let problem = Problem { scene, camera, antialiased, before: None };
        area.add(name, problem.scene.len(), catches, move || problem.clone());
    };
    let still = || camera(70, 53);
    let keep = |_: usize, _: &mut [f32; 3], _: &mut [f32; 3], _: &mut f32| ();
    let seen = || Catches::from([Blank, LastTile, Missing, HalfPixel]);
    let many = || seen().and(&[BackToFront, NeighborColor, Unrotated, TransposedPixels]);
    for (count, degree) in [(1, 0), (10, 1), (100, 2), (1000, 3)] {
        let more: &[Fault] =
            if count == 1 { &[] } else { &[BackToFront, NeighborColor, Unrotated, FaintDrawn, NoBands] };
        let faults = || seen().and(&[OtherAntialiasing, HalfColors]).and(more);
        add(&format!("random, degree {degree}"), faults(), (scene(count, degree, keep), still()), false);
        add(&format!("random, degree {degree}, antialiased"), faults(), (scene(count, degree, keep), still()), true);
    }
    let pose = Pose {
        rotation: DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.1),
        translation: DVec3::new(3.0, -1.0, 2.0),
    };
    add("a turned camera", many().and(&[DirectionInCamera]), turned(scene(60, 1, keep), pose), false);
    for distance in [1e4, 1e6] {
        let far = Pose { translation: distance * DVec3::new(1.0 / 3.0, 0.1, 1.0 / 7.0), ..pose };
        // Distinct depths even at a precision of a sixteenth.
        let spread = |i: usize, m: &mut [f32; 3], _: &mut [f32; 3], _: &mut f32| {
            let depth = 1.0 + 0.25 * i as f32;
            *m = m.map(|x| x * depth / m[2]);
        };
        let far = turned(scene(40, 2, spread), far);
        add(&format!("scene and camera {distance:e} off"), many().and(&[DirectionInCamera]), far, false);
    }
    for distance in [1e3, 1e5] {
        let off = (needles_off(40, distance), still());
        add(&format!("needles {distance:e} pixels off the picture"), [Blank, Missing, BackToFront].into(), off, false);
    }
    let needles = |_: usize, _: &mut [f32; 3], s: &mut [f32; 3], _: &mut f32| *s = [0.0, 1e-6, 15.0];
    let thin = || many().and(&[CancellingDeterminant, OtherAntialiasing]);
    add("scales of 0, 1e-6 and 15 in one", thin(), (scene(50, 0, needles), still()), false);
    let none = [OtherAntialiasing];
    add("scales of 0, 1e-6 and 15 in one, antialiased", none.into(), (scene(50, 0, needles), still()), true);
    add("points", seen().and(&[BackToFront]), (scene(200, 0, |_, _, s, _| *s = [0.0; 3]), still()), false);
    let over = scene(1, 1, |_, m, s, _| (*m, *s) = ([0.1, 0.2, 3.0], [50.0; 3]));
    add("one over all tiles", [Blank, LastTile, Missing].into(), (over, still()), false);
    for length in [1e-20, 1e-3, 1e3, 1e20] {
        let mut stretched = scene(60, 0, keep);
        stretched.quats.iter_mut().flatten().for_each(|q| *q *= length);
        add(&format!("rotations of length {length:e}"), many(), (stretched, still()), false);
    }
    let level = scene(300, 0, |_, m, s, _| (m[2], *s) = (3.0, [0.1; 3]));
    add("equal depths", seen().and(&[BackToFront, NeighborColor]), (level, still()), false);
    let near = scene(40, 0, |i, m, s, _| {
        // Not 0.01 itself, which f32 rounds down.
        let z = f32::from_bits(0.01f32.to_bits() + i as u32 - if i < 20 { 20 } else { 19 });
        (*m, *s) = ([0.3 * m[0] * z, 0.3 * m[1] * z, z], [1e-3; 3]);
    });
    add("on the near plane", seen().and(&[NearDrawn]), (near, still()), false);
    let wide = scene(40, 1, |_, m, s, _| m.iter_mut().chain(s).for_each(|v| *v *= 1e6));
    add("at distances of 1e6", many(), (wide, still()), false);
    add("all behind", [BehindDrawn].into(), (scene(40, 0, |_, m, _, _| m[2] = -m[2]), still()), false);
    let inside = scene(5, 1, |i, m, s, _| (*m, *s) = ([0.0, 0.01, 0.1 * (i + 1) as f32], [2.0; 3]));
    add("camera inside", [Blank, LastTile, Missing, BackToFront].into(), (inside, still()), false);
    let faint = |i: usize, _: &mut [f32; 3], _: &mut [f32; 3], o: &mut f32| {
        *o = [0.0, 1.0 / 255.0, 1.0, 0.0039, 0.00393, 0.999][i % 6];
    };
    let limits = || seen().and(&[FaintDrawn]);
    add("opacities of 0, 1/255 and 1", limits(), (scene(120, 0, faint), still()), false);
    add("opacities of 0, 1/255 and 1, antialiased", seen().and(&[FaintDrawn]), (scene(120, 0, faint), still()), true);
    let wall = |i: usize, m: &mut [f32; 3], s: &mut [f32; 3], o: &mut f32| {
        (*m, *s, *o) = ([0.0, 0.0, 2.0 + i as f32], [40.0; 3], 1.0);
    };
    let walls = [Blank, Missing, BackToFront, OpaqueUnclamped, NeverStops];
    add("opaque layers", walls.into(), (scene(4, 0, wall), still()), false);
    let mut dark = scene(80, 3, keep);
    dark.sh_coeffs.iter_mut().flatten().for_each(|c| *c = 2.0 * *c - 1.0);
    add("colors below zero", many().and(&[NegativeColors, NoBands]), (dark, still()), false);
    for (width, height) in [(1, 1), (1, 2048), (2048, 1), (17, 33)] {
        let sides = [Blank, LastTile, Missing, HalfPixel];
        add(&format!("{width} x {height} pixels"), sides.into(), (scene(40, 0, keep), camera(width, height)), false);
    }
    add("no Gaussians", [Unwritten].into(), (Scene::default(), still()), false);
    let mut far_off = still();
    (far_off.intrinsics.cx, far_off.intrinsics.cy) = (-60.0, 400.0);
    add("principal point outside", [CenteredPrincipal].into(), (scene(200, 0, keep), far_off), false);
    for degrees in [1.0f32, 179.0] {
        // The default view through a narrower or wider lens.
        let (half, mut lens) = ((0.5 * degrees).to_radians().tan(), still());
        let f = f64::from(lens.intrinsics.width) / 2.0 / f64::from(half);
        (lens.intrinsics.fx, lens.intrinsics.fy) = (f, f);
        let through = scene(60, 1, |_, m, s, _| {
            (m[0], m[1]) = (2.0 * half * m[0], 2.0 * half * m[1]);
            s.iter_mut().for_each(|s| *s *= 2.0 * half);
        });
        add(&format!("a field of view of {degrees}°"), seen(), (through, lens), false);
    }
    // 2048 tiles per picture: the last tile indices exceed 65,535.
    const BEFORE: usize = 32;
    let make = || {
        let wide = camera(1 << 15, 1);
        let mut moved = wide;
        moved.intrinsics.cx += 1000.0;
        let scene = scene(40, 0, |_, m, s, _| (m[1], *s) = (0.0, s.map(|s| 0.05 * s)));
        Problem { scene, camera: moved, antialiased: false, before: Some((wide, BEFORE)) }
    };
    area.add("more than 65,536 tiles", 40, [Blank, LastTile, Missing, TilesWrap], make);
    area
}
