use crate::case::*;
use zipsplat::{kernels::render::Normals, stages::render::camera_rows};
use zipsplat_tests::reference::render::normals;

#[test]
fn equals_the_eigenvectors_of_the_covariances() {
    let turned = Pose { rotation: glam::DMat3::from_rotation_y(0.7), translation: [3.0, 0.5, 2.0].into() };
    for (count, off) in [(0, 0.0), (1, 0.0), (63, 0.0), (64, 0.0), (1000, 0.0), (1000, 1e6)] {
        let mut cameras = [camera(64, 64), Camera { pose: turned, ..camera(64, 64) }];
        let mut scene = random_scene(count, 0, 0.3);
        cameras.iter_mut().for_each(|camera| camera.pose.translation += off / 3.0);
        scene.means.iter_mut().flatten().for_each(|x| *x = (f64::from(*x) + off / 3.0) as f32);
        let mut case = plan();
        let pairs = count * cameras.len();
        let kernel = Normals {
            means: case.input(&scene.means),
            scales: case.input(&scene.scales),
            quats: case.input(&scene.quats),
            cameras: case.input(&cameras.map(|camera| camera_rows(&camera))),
            normals: case.output::<[f32; 3]>(pairs),
            pairs: pairs as u32,
            camera_count: cameras.len() as u32,
        };
        case.rec.dispatch(kernel, pairs);
        let got: Vec<[f32; 3]> = case.result(kernel.normals).unwrap();
        let gaussians = reference_gaussians(&scene);
        for (pair, normal) in got.iter().enumerate() {
            let (i, camera) = (pair / cameras.len(), reference_camera(&cameras[pair % cameras.len()]));
            let mut lengths = scene.scales[i];
            lengths.sort_by(f32::total_cmp);
            // Nearly equal axes may swap, and a normal across the line of sight has either sign.
            let truth = normals::normal(&gaussians, i, &camera);
            let across =
                glam::DVec3::from(truth).dot((camera.center() - glam::DVec3::from(gaussians.means[i])).normalize());
            if lengths[0] > 0.999 * lengths[1] || across.abs() < 1e-5 {
                continue;
            }
            let error = (0..3).map(|k| (f64::from(normal[k]) - truth[k]).abs()).fold(0.0, f64::max);
            assert!(error < 2e-6, "pair {pair}: {normal:?}, not {truth:?}");
        }
    }
}
