//! Where in a scene a photo was taken: the camera whose picture of the scene is most like the photo.

use crate::{
    capture::{draw, draw_all},
    metrics::{psnr, values},
};
use glam::{DMat3, DQuat, DVec3};
use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
use nalgebra::{DVector, Dyn, OMatrix, U6, Vector6, storage::Owned};
use std::{cell::RefCell, iter::successors};
use zipsplat::{
    Result,
    stages::render::Renderer,
    types::{Camera, Image, Pose, resample::resize_lanczos},
};

/// Shortest side of the smallest picture that is compared.
const SMALLEST: u32 = 20;
/// Half the length of central differences, in pixels that what is at distance 1 moves.
const DIFFERENCE: f64 = 0.5;
/// Where a step gains less than this share, or is shorter than it, the pictures of a size are done.
const TOLERANCE: f64 = 1e-4;
/// At a size at most 7 times so many movements are tried.
const PATIENCE: usize = 12;

/// What [`align`] found.
pub struct Aligned {
    /// The camera.
    pub camera: Camera,
    /// The scene as it sees it, `[height][width][rgb]` in 0..1.
    pub drawn: Vec<f32>,
    /// As the camera sees it that the search began with.
    pub before: Vec<f32>,
}

/// Turns and moves `camera` until its picture of the scene that a renderer holds has the least squared error to `photo`, of
/// the camera's size; at a distance of about 1 there should be something to see. Its lens stays.
///
/// Levenberg-Marquardt over the 6 degrees of freedom, derivatives by central differences, from small pictures to those of
/// full size, where the camera that it began with is kept if none is better. Before each drawing `check` is asked.
///
/// # Errors
/// As [`Renderer::render_loaded`], and those of `check`.
pub fn align(
    renderer: &mut Renderer,
    photo: &Image,
    camera: &Camera,
    check: &dyn Fn() -> Result<()>,
) -> Result<Aligned> {
    let halves = successors(Some((photo.width, photo.height)), |(width, height)| Some((width / 2, height / 2)));
    let sizes: Vec<_> = halves.enumerate().take_while(|(i, size)| *i == 0 || size.0.min(size.1) >= SMALLEST).collect();
    let mut pose = camera.pose;
    for (_, (width, height)) in sizes.into_iter().rev() {
        let start = Camera { pose, intrinsics: camera.intrinsics.resized(width, height) };
        let problem = Search::new(renderer, &resize_lanczos(photo, width, height)?, start, check);
        let solver = LevenbergMarquardt::new().with_ftol(TOLERANCE).with_xtol(TOLERANCE).with_patience(PATIENCE);
        let (found, _) = solver.minimize(problem);
        found.failure.into_inner()?;
        pose = moved(&found.start, &found.movement).pose;
    }
    let found = Camera { pose, ..*camera };
    let [before, drawn] = [camera, &found].map(|camera| draw(renderer, camera));
    let (before, drawn, truth) = (before?, drawn?, values(photo));
    // Small pictures may be most alike elsewhere.
    Ok(match psnr(&drawn, &truth) > psnr(&before, &truth) {
        true => Aligned { camera: found, drawn, before },
        false => Aligned { camera: *camera, drawn: before.clone(), before },
    })
}

/// The search among pictures of one size.
struct Search<'a> {
    renderer: RefCell<&'a mut Renderer>,
    check: &'a dyn Fn() -> Result<()>,
    /// Of the drawing that failed.
    failure: RefCell<Result<()>>,
    truth: DVector<f64>,
    start: Camera,
    movement: Vector6<f64>,
}

/// `camera` turned about its axes (radians, the first three numbers) and moved along them (the other three).
fn moved(camera: &Camera, movement: &Vector6<f64>) -> Camera {
    let [turn, shift] = [0, 3].map(|i| DVec3::from_slice(&movement.as_slice()[i..i + 3]));
    let movement = Pose { rotation: DMat3::from_quat(DQuat::from_scaled_axis(turn)), translation: shift };
    Camera { pose: camera.pose.compose(&movement), ..*camera }
}

impl<'a> Search<'a> {
    fn new(renderer: &'a mut Renderer, photo: &Image, start: Camera, check: &'a dyn Fn() -> Result<()>) -> Self {
        Self {
            renderer: RefCell::new(renderer),
            check,
            failure: RefCell::new(Ok(())),
            truth: DVector::from_iterator(photo.rgb.len(), values(photo).into_iter().map(f64::from)),
            start,
            movement: Vector6::zeros(),
        }
    }

    /// Pictures from where movements lead.
    fn pictures(&self, movements: &[Vector6<f64>]) -> Option<Vec<Vec<f32>>> {
        let cameras: Vec<Camera> = movements.iter().map(|movement| moved(&self.start, movement)).collect();
        let drawn = (self.check)().and_then(|()| draw_all(&mut self.renderer.borrow_mut(), &cameras));
        drawn.map_err(|error| *self.failure.borrow_mut() = Err(error)).ok()
    }
}

impl LeastSquaresProblem<f64, Dyn, U6> for Search<'_> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, U6>;
    type ParameterStorage = Owned<f64, U6>;

    fn set_params(&mut self, movement: &Vector6<f64>) {
        self.movement = *movement;
    }

    fn params(&self) -> Vector6<f64> {
        self.movement
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        let picture = self.pictures(&[self.movement])?.remove(0);
        Some(DVector::from_iterator(picture.len(), picture.into_iter().map(f64::from)) - &self.truth)
    }

    fn jacobian(&self) -> Option<OMatrix<f64, Dyn, U6>> {
        let half = DIFFERENCE / self.start.intrinsics.fx;
        let step = |i: usize| Vector6::from_fn(|row, _| if row == i { half } else { 0.0 });
        let movements: Vec<_> = (0..6).flat_map(|i| [self.movement + step(i), self.movement - step(i)]).collect();
        let pictures = self.pictures(&movements)?;
        let slope = |(a, b): (&f32, &f32)| f64::from(a - b) / (2.0 * half);
        let columns = pictures.chunks_exact(2).flat_map(|pair| pair[0].iter().zip(&pair[1]).map(slope));
        Some(OMatrix::<f64, Dyn, U6>::from_iterator(self.truth.len(), columns))
    }
}
