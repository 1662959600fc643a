use super::*;

/// By a degree and 1 % of the scene's distance, except the first and `held_out`.
fn disturbed(cameras: &[Camera], held_out: usize) -> Vec<Camera> {
    let disturb = |(i, camera): (usize, &Camera)| {
        let direction = |k: f64| DVec3::new((k * 2.4).sin(), (k * 1.7).cos(), (k * 0.9).sin()).normalize();
        let rotation = DMat3::from_axis_angle(direction(i as f64), 1f64.to_radians());
        let movement = Pose { rotation, translation: 0.035 * direction(i as f64 + 0.5) };
        let stays = i == 0 || i == held_out;
        Camera { pose: if stays { camera.pose } else { camera.pose.compose(&movement) }, ..*camera }
    };
    cameras.iter().enumerate().map(disturb).collect()
}

/// Means in degrees and distance.
fn distance(found: &[Camera], truth: &[Camera]) -> [f64; 2] {
    let errors: Vec<Pose> = found.iter().zip(truth).map(|(a, b)| a.pose.relative_to(&b.pose)).collect();
    let mean = |of: fn(&Pose) -> f64| errors.iter().map(of).sum::<f64>() / errors.len() as f64;
    let degrees = mean(|error| DQuat::from_mat3(&error.rotation).to_scaled_axis().length().to_degrees());
    [degrees, mean(|error| error.translation.length())]
}

fn refine_cameras(scene: &Scene, photos: &[Image], cameras: &[Camera], optimize_cameras: bool) -> RefineResult {
    let request = RefineOptions {
        length: RefineLength::Steps(100),
        optimize_cameras,
        holdout_views: Some(1),
        ..RefineOptions::default()
    };
    refine(&moved(scene), photos, cameras, &request)
}

#[test]
fn disturbed_cameras_come_back() {
    let truth = cameras(9);
    let (scene, photos) = photos(&truth);
    let given = disturbed(&truth, 4);
    let [still, refined] = [false, true].map(|optimize| refine_cameras(&scene, &photos, &given, optimize));
    assert_eq!((&still.cameras, refined.cameras[0], refined.cameras[4]), (&given, given[0], given[4]));
    let ([degrees, shift], before) = (distance(&refined.cameras, &truth), distance(&given, &truth));
    assert!(4.0 * degrees < before[0] && 2.5 * shift < before[1], "{before:?} to {degrees} degrees and {shift}");
    let [[without, _], [with, _]] = [still, refined].map(|refined| refined.psnr().unwrap());
    assert!(with > without + 1.0, "{without} dB without, {with} dB with refined cameras");
}

#[test]
fn exact_cameras_stay_exact() {
    let cameras = cameras(9);
    let (scene, photos) = photos(&cameras);
    let [still, refined] = [false, true].map(|optimize| refine_cameras(&scene, &photos, &cameras, optimize));
    let [degrees, shift] = distance(&refined.cameras, &cameras);
    assert!(degrees > 0.0 && degrees < 0.2 && shift < 0.01, "{degrees} degrees and {shift}");
    let [[without, _], [with, _]] = [still, refined].map(|refined| refined.psnr().unwrap());
    assert!(with > 43.5 && with > without - 3.5, "{without} dB without, {with} dB with refined cameras");
}
