use super::{FrameShape, RenderOptions, SceneTensors};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::render::{Normals, Project},
    ops::row_chunks,
    types::{Camera, Pose},
};
use glam::DVec4;

/// Rows of the world-to-camera rotation with the center, then `(fx, fy, cx, cy)` in pixels.
pub type CameraRows = [[f32; 4]; 8];

/// Converts a camera to 48-bit precision.
pub fn camera_rows(camera: &Camera) -> CameraRows {
    let (i, Pose { rotation, translation }) = (&camera.intrinsics, &camera.pose);
    let row = |r: usize| rotation.col(r).extend(translation[r]);
    let rows = [row(0), row(1), row(2), DVec4::new(i.fx, i.fy, i.cx, i.cy)];
    let rest = rows.map(|row| row - row.as_vec4().as_dvec4());
    std::array::from_fn(|r| if r < 4 { rows[r].as_vec4() } else { rest[r - 4].as_vec4() }.to_array())
}

/// Projected Gaussian-camera pairs, Gaussian-major.
pub(super) struct Splats {
    pub pairs: usize,
    pub xy_opacities: Tensor,
    pub conics: Tensor,
    /// `[pairs, 3]`.
    pub colors: Option<Tensor>,
    /// `[pairs, 3]`.
    pub normals: Option<Tensor>,
    pub depths: Tensor,
    pub tile_sets: Tensor,
    pub indices: Tensor,
}

pub(super) fn record(
    rec: &mut Recorder,
    scene: &SceneTensors,
    cameras: Tensor,
    shape: FrameShape,
    options: &RenderOptions,
) -> Splats {
    let pairs = scene.len * shape.cameras;
    let tensor = |rec: &mut Recorder, name, words| rec.tensor::<u32>(name, words * pairs.max(1));
    let splats = Splats {
        pairs,
        xy_opacities: tensor(rec, "xy_opacities", 3),
        conics: tensor(rec, "conics", 3),
        colors: options.rgb.then(|| tensor(rec, "colors", 3)),
        normals: options.normals.then(|| tensor(rec, "normals", 3)),
        depths: tensor(rec, "depths", 1),
        tile_sets: tensor(rec, "tile_sets", 3),
        indices: tensor(rec, "indices", 1),
    };
    let sh_bytes = 4 * SceneTensors::widths(scene.sh_degree)[4];
    for part in row_chunks(rec, scene.len, &[4, 16, sh_bytes, 12 * shape.cameras]) {
        let (first, len) = (part.start, part.len());
        let pair = |tensor: Tensor, words: usize| {
            tensor.slice::<u32>(words * first * shape.cameras, words * len * shape.cameras)
        };
        let SceneTensors { means, scales, quats, opacities, sh_coeffs, .. } = scene.part(part);
        let kernel = Project {
            means,
            scales,
            quats,
            opacities,
            sh_coeffs,
            cameras,
            xy_opacities: pair(splats.xy_opacities, 3),
            conics: pair(splats.conics, 3),
            // A placeholder without colors.
            colors: pair(splats.colors.unwrap_or(splats.xy_opacities), 3),
            depths: pair(splats.depths, 1),
            tile_sets: pair(splats.tile_sets, 3),
            indices: pair(splats.indices, 1),
            pairs: (len * shape.cameras) as u32,
            first_pair: (first * shape.cameras) as u32,
            camera_count: shape.cameras as u32,
            width: shape.width,
            height: shape.height,
            near: options.near_plane(),
            color: options.rgb,
            sh_degree: scene.sh_degree,
            antialiased: options.is_antialiased(),
        };
        rec.dispatch(kernel, len * shape.cameras);
        if let Some(normals) = splats.normals {
            let Project { pairs, camera_count, .. } = kernel;
            let kernel = Normals { means, scales, quats, cameras, normals: pair(normals, 3), pairs, camera_count };
            rec.dispatch(kernel, len * shape.cameras);
        }
    }
    splats
}
