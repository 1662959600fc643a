use crate::prelude::*;
use glam::{DMat3, DVec3};
use std::f64::consts::{FRAC_PI_2, PI};
use zipsplat::types::{Camera, Intrinsics, Pose, prior_encoding};
use zipsplat_reference::backbone::camera_encoder::{Prior, encode};

const REASON: &str = "computed in f64 and rounded to f32 once, which moves a value by its unit roundoff; f64 adds 1e-14 of the \
    camera's distance";

struct Problem(Vec<Camera>);

#[derive(Clone, Copy, Debug)]
enum Fault {
    CameraToWorld,
    Conjugate,
    /// Quaternion as wxyz.
    RealFirst,
    /// The trace's cosine cannot represent small angles.
    AngleFromTrace,
    /// Cancels near half turns.
    RealFromTrace,
    NegativeReal,
    SwappedFields,
    Degrees,
    /// Fields of view from the principal point.
    OffCentre,
    HalfTranslation,
    NeighborCamera,
}

fn prior(camera: &Camera, pose: Pose) -> Prior {
    let i = &camera.intrinsics;
    let mut values = [0.0; 12];
    values[..9].copy_from_slice(&pose.rotation.transpose().to_cols_array());
    values[9..].copy_from_slice(&pose.translation.to_array());
    Prior { camera: [f64::from(i.width), f64::from(i.height), i.fx, i.fy, i.cx, i.cy], pose: values }
}

impl Fault {
    fn apply(self, camera: &Camera, mut truth: [f64; 9]) -> [f64; 9] {
        let i = &camera.intrinsics;
        match self {
            Fault::CameraToWorld => truth = encode(&prior(camera, camera.pose.inverse())),
            Fault::Conjugate => truth[3..6].iter_mut().for_each(|q| *q = -*q),
            Fault::RealFirst => truth[3..7].rotate_right(1),
            Fault::AngleFromTrace => {
                truth[3..6].iter_mut().filter(|q| q.abs() < 1e-8).for_each(|q| *q = 0.0);
            }
            Fault::RealFromTrace => truth[6] = f64::from((truth[6].powi(2) as f32 + 1.0 - 1.0).sqrt()),
            Fault::NegativeReal => truth[3..7].iter_mut().for_each(|q| *q = -*q),
            Fault::SwappedFields => truth.swap(7, 8),
            Fault::Degrees => truth[7..].iter_mut().for_each(|angle| *angle = angle.to_degrees()),
            Fault::OffCentre => truth[7] = 2.0 * (i.cy / i.fy).atan(),
            Fault::HalfTranslation => truth[..3].iter_mut().for_each(|t| *t = half(*t)),
            Fault::NeighborCamera => {}
        }
        truth
    }
}

impl case::Problem for Problem {
    type Output = Vec<[f32; 9]>;
    type Truth = Vec<[f64; 9]>;
    type Fault = Fault;

    fn compute(&self, _: &Device, _: Mode) -> Result<Self::Output> {
        prior_encoding(&self.0)
    }

    fn truth(&self, _: Mode) -> Self::Truth {
        self.0.iter().map(|camera| encode(&prior(camera, camera.pose))).collect()
    }

    fn judge(&self, truth: &Self::Truth, output: &Self::Output, _: Mode) -> Worst {
        let mut worst = Worst::NONE;
        for (camera, (got, truth)) in self.0.iter().zip(output.iter().zip(truth)) {
            // At half turns, w is 0 and either sign is right.
            let turned = got[3..7].iter().zip(&truth[3..7]).map(|(&a, b)| f64::from(a) * b).sum::<f64>() < 0.0;
            let sign = if turned && got[6].abs() < 1e-6 { -1.0 } else { 1.0 };
            let slack = 1e-14 * (1.0 + camera.pose.translation.length());
            for (c, (&got, &truth)) in got.iter().zip(truth).enumerate() {
                let truth = if (3..7).contains(&c) { sign * truth } else { truth };
                worst = worst.or(Worst::one(got.into(), truth, U * truth.abs() + slack));
            }
        }
        worst
    }

    fn zeros(&self, truth: &Self::Truth) -> Option<Self::Output> {
        Some(vec![[0.0; 9]; truth.len()])
    }

    fn faulty(&self, truth: &Self::Truth, fault: Fault, _: Mode) -> Vec<Self::Output> {
        let cameras = self.0.iter().zip(truth);
        let mut wrong: Vec<_> = cameras.map(|(camera, truth)| fault.apply(camera, *truth).map(|x| x as f32)).collect();
        if matches!(fault, Fault::NeighborCamera) {
            wrong.rotate_left(1);
        }
        vec![wrong]
    }
}

fn camera(rotation: DMat3, translation: DVec3, degrees: f64) -> Camera {
    let fov = degrees.to_radians();
    Camera { intrinsics: Intrinsics::from_fov(640, 480, fov, 0.9 * fov), pose: Pose { rotation, translation } }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("camera encoding", "cameras", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, cameras: Vec<Camera>| {
        area.add(name, cameras.len(), catches, move || Problem(cameras.clone()));
    };
    let axes = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE.normalize(), DVec3::new(1.0, -1e-9, 0.0).normalize()];
    let turns = |angles: &[f64]| {
        let turn =
            |&axis: &DVec3| angles.iter().map(move |&angle| DMat3::from_axis_angle(axis, angle)).collect::<Vec<_>>();
        axes.iter().flat_map(turn).map(|r| camera(r, DVec3::new(0.3, -1.0, 2.0), 60.0)).collect::<Vec<_>>()
    };
    let turned = || Catches::from([CameraToWorld, Conjugate, RealFirst, SwappedFields, Degrees, NeighborCamera]);
    add("rotations of 0", turned().and(&[AngleFromTrace, NegativeReal]), turns(&[0.0, 1e-9, -1e-4]));
    let halves = turns(&[PI, PI - 1e-9, PI + 1e-9, PI - 1e-4, PI + 1e-4]);
    add("rotations of 180 degrees", turned().and(&[RealFromTrace, NegativeReal]), halves);
    add("rotations of 90 and 120 degrees", turned(), turns(&[FRAC_PI_2, -FRAC_PI_2, 2.0 * PI / 3.0]));
    let signs = turns(&(0..24).map(|i| f64::from(i) * PI / 6.0 - 2.0 * PI).collect::<Vec<_>>());
    add("every sign of a quaternion", turned().and(&[NegativeReal]), signs);
    let still = |degrees: f64| camera(DMat3::IDENTITY, DVec3::ZERO, degrees);
    let fields = [SwappedFields, Degrees, NeighborCamera];
    add("fields of view of 1 to 179 degrees", fields.into(), (1..180).map(|d| still(f64::from(d))).collect());
    let mut outside = still(60.0);
    (outside.intrinsics.cx, outside.intrinsics.cy) = (-900.0, 5_000.0);
    add("principal point outside", [OffCentre].into(), vec![outside]);
    add("identical poses", [RealFirst].into(), vec![still(50.0); 5]);
    let apart =
        |length: f64| move |i: i32| camera(DMat3::from_rotation_y(0.1), DVec3::X * (length * f64::from(i)), 60.0);
    let line = || Catches::from([CameraToWorld, HalfTranslation, NeighborCamera]);
    add("cameras in a line", line(), (0..9).map(apart(1.0)).collect());
    add("baselines of 1e-6", line(), (0..3).map(apart(1e-6)).collect());
    add("baselines of 1e6", line(), (0..3).map(apart(1e6)).collect());
    area
}
