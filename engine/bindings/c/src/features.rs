//! Features: values of any number of channels, held by Gaussians or tokens.

use super::{
    camera::{read_cameras, zs_camera},
    image::zs_pixel_values,
    pointers::{array, array_mut, borrow, read_array},
    renderer::zs_renderer,
    scene::zs_scene,
    status::{Failure, guard, zs_status},
};
use zipsplat::{
    Scene,
    features::{FeatureRenderer, Features, PixelValues},
};

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_lift_features(
    renderer: *const zs_renderer,
    scene: *const zs_scene,
    cameras: *const zs_camera,
    values: *const zs_pixel_values,
    count: usize,
    channels: usize,
    group: usize,
    features: *mut f32,
    weights: *mut f32,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, scene, values, cameras) = unsafe {
            let (renderer, scene) = (borrow(renderer, "renderer")?, borrow(scene, "scene")?);
            (renderer, scene, read_array(values, count, "values")?, read_cameras(cameras, count)?)
        };
        let plane = |(i, given): (usize, &zs_pixel_values)| {
            let len = (given.width as usize).saturating_mul(given.height as usize).saturating_mul(channels);
            // SAFETY: the caller's memory, as large as the structure says.
            unsafe { array(given.values, len, &format!("values {i}")) }
        };
        let planes = values.iter().enumerate().map(plane).collect::<Result<Vec<&[f32]>, _>>()?;
        let picture = |i: usize| {
            let zs_pixel_values { width, height, .. } = values[i];
            Ok(PixelValues { width, height, channels, values: planes[i].to_vec() })
        };
        let found = with(renderer, |drawing| drawing.lift(&scene.scene, &cameras, group, channels, picture))?;
        // SAFETY: the caller's memory, as long as documented.
        unsafe {
            array_mut(features, found.features.values.len(), "features")?.copy_from_slice(&found.features.values);
            if !weights.is_null() {
                array_mut(weights, found.weights.len(), "weights")?.copy_from_slice(&found.weights);
            }
        }
        Ok(())
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_render_features(
    renderer: *const zs_renderer,
    scene: *const zs_scene,
    features: *const f32,
    channels: usize,
    group: usize,
    cameras: *const zs_camera,
    count: usize,
    pictures: *mut f32,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, scene, cameras) =
            unsafe { (borrow(renderer, "renderer")?, borrow(scene, "scene")?, read_cameras(cameras, count)?) };
        let scene: &Scene = &scene.scene;
        let len = (scene.len() / group.max(1)).saturating_mul(channels);
        // SAFETY: the caller's memory, as long as documented.
        let values = unsafe { array(features, len, "features") }?.to_vec();
        let features = Features { values, channels, group };
        let found = with(renderer, |drawing| drawing.draw(scene, &features, &cameras))?;
        let mut to = pictures;
        for picture in found {
            // SAFETY: the caller's memory, as long as documented.
            unsafe {
                array_mut(to, picture.values.len(), "pictures")?.copy_from_slice(&picture.values);
                to = to.add(picture.values.len());
            }
        }
        Ok(())
    })
}

fn with<T>(
    renderer: &zs_renderer,
    run: impl FnOnce(&mut FeatureRenderer) -> zipsplat::Result<T>,
) -> Result<T, Failure> {
    let mut features = renderer.features();
    let features = features.get_or_insert_with(|| FeatureRenderer::new(renderer.lock().device()));
    Ok(run(features)?)
}
