//! The engine's networks, photos and cameras for the reference.

use zipsplat::{
    Result,
    reconstruct::KvPool,
    types::{Camera, Image, Intrinsics},
    weights::{Checkpoint, Values},
};
use zipsplat_reference::{
    backbone::{camera_encoder::Prior, patchify::Images},
    model::{Architecture, Model, Weights},
    ops::split_heads::Keys,
};

pub fn weights(values: &Values) -> Result<Weights> {
    let read = |(name, shape): &(String, Vec<usize>)| {
        let mut read = vec![0.0; shape.iter().product()];
        values.read_f32(name, &mut read)?;
        Ok((name.clone(), (shape.clone(), read)))
    };
    values.parameters().iter().map(read).collect()
}

pub fn model(checkpoint: &Checkpoint) -> Result<Model> {
    let a = checkpoint.architecture();
    let architecture = Architecture {
        patch: a.patch_size,
        width: a.width,
        depth: a.depth,
        heads: a.heads,
        alt_start: a.alt_start,
        rope_start: a.rope_start,
        out_layers: a.out_layers.clone(),
        camera_blocks: a.camera_depth,
        camera_heads: a.camera_heads,
        fusion_heads: a.fusion_heads,
        color_width: a.color_width,
        color_heads: a.color_heads,
        gaussians: a.gaussians_per_token,
        sh_degree: a.sh_degree,
    };
    Ok(Model { architecture, weights: weights(checkpoint)? })
}

pub fn keys(pool: KvPool) -> Keys {
    match pool {
        KvPool::Fixed { sides, own, first } => Keys { sides: sides.into(), own, first },
        KvPool::Auto => Keys::all(),
    }
}

pub fn prior(Camera { intrinsics, pose }: &Camera) -> Prior {
    let Intrinsics { width, height, fx, fy, cx, cy } = *intrinsics;
    let mut rows = [0.0; 12];
    rows[..9].copy_from_slice(&pose.rotation.transpose().to_cols_array());
    rows[9..].copy_from_slice(&pose.translation.to_array());
    Prior { camera: [width.into(), height.into(), fx, fy, cx, cy], pose: rows }
}

pub fn images(images: &[Image]) -> Images {
    let [width, height] = images.first().map_or([0; 2], |image| [image.width, image.height].map(|side| side as usize));
    let channels = images.iter().flat_map(|image| (0..3).flat_map(|channel| image.rgb[channel..].iter().step_by(3)));
    let bytes: Vec<u8> = channels.copied().collect();
    Images::from_u8(&bytes, &[images.len(), 3, height, width])
}
