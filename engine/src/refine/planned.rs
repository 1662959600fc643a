use super::{
    PerceptualLoss, RefineOptions,
    dropout::record_dropout,
    exposed::{COLORS, EXPOSURE_NUMBERS, Exposed},
    views::View,
};
use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    stages::{
        SceneTensors,
        depth_loss::DepthFrames,
        loss::{LossTensors, record_loss, record_mask, record_targets},
        lpips::{Lpips, LpipsPictures},
        render::{
            CAMERA_NUMBERS, CameraRows, Depth, FrameInputs, FrameShape, Gradients, RenderOptions, RenderOutputs,
            camera_rows,
        },
    },
};

/// A plan that renders photos' cameras and, in training, accumulates gradients.
pub(super) struct PhotoPlan {
    pub run: Run,
    pub recorded: Recorded,
}

#[derive(Clone, Copy)]
pub(super) struct Recorded {
    pub cameras: Tensor,
    pub learning: Option<Learning>,
    pub outputs: RenderOutputs,
}

#[derive(Clone, Copy)]
pub(super) struct Learning {
    /// Key of the hidden Gaussians, `[1]`, unless all are shown.
    pub dropout_key: Option<Tensor>,
    /// `[cameras, height, width, 3]` bytes, in whole words.
    pub photos: Tensor,
    /// `[cameras, height, width]` bytes, in whole words, if photos have masks.
    pub masks: Option<Tensor>,
    /// `[cameras]`.
    pub losses: Tensor,
    pub perceptual: Option<(f32, Tensor)>,
    /// `[cameras, 10]`, if cameras are refined.
    pub d_cameras: Option<Tensor>,
    /// Color transforms `[cameras, 3, 4]` and their gradient, if exposures are learned.
    pub exposures: Option<[Tensor; 2]>,
    pub depth: Option<DepthTensors>,
}

#[derive(Clone, Copy)]
pub(super) struct DepthTensors {
    /// `[cameras, height, width]`.
    targets: Tensor,
    /// Factor of the gradient, and that of the step's photos in it.
    weight: Tensor,
    share: f32,
    /// `[cameras]`.
    value: Tensor,
}

#[derive(Clone, Copy)]
pub(super) struct Training<'a> {
    pub options: &'a RefineOptions,
    pub gradients: &'a Gradients,
    pub lpips: Option<&'a Lpips>,
    /// Fraction of the Gaussians to hide.
    pub dropout: f64,
    pub exposure: bool,
    pub masked: bool,
    /// Whether any photo has depth, for the depth loss.
    pub depth: bool,
}

#[derive(Clone, Copy, Default)]
pub(super) struct StepInputs {
    pub depth_weight: f32,
    pub dropout_key: u32,
}

pub(super) struct PhotoLoss {
    pub photo: usize,
    pub loss: f32,
    /// Camera gradient d loss / d (w, v), if cameras are refined.
    pub d_pose: Option<[f32; 6]>,
    /// Gradient by the color transform, if exposures are learned.
    pub d_exposure: Option<[f32; EXPOSURE_NUMBERS]>,
}

pub(super) fn record_photos(
    rec: &mut Recorder,
    scene: &SceneTensors,
    shape: FrameShape,
    capacity: usize,
    drawing: &RenderOptions,
    training: Option<Training<'_>>,
) -> Recorded {
    let FrameShape { cameras: count, width, height } = shape;
    let cameras = rec.input::<CameraRows>("cameras", count);
    let Some(Training { options, gradients, lpips, dropout, exposure, masked, depth }) = training else {
        let outputs = FrameInputs { scene, cameras, shape, options: drawing, capacity }.record(rec);
        return Recorded { cameras, learning: None, outputs };
    };
    let dropout_key = (dropout > 0.0).then(|| rec.input::<u32>("dropout_key", 1));
    let shown = |key| record_dropout(rec, scene.opacities, key, dropout, scene.len);
    let scene = &SceneTensors { opacities: dropout_key.map_or(scene.opacities, shown), ..*scene };
    let d_cameras = options.optimize_cameras.then(|| {
        let d_cameras = rec.tensor::<[f32; CAMERA_NUMBERS]>("d_cameras", count);
        rec.fill(d_cameras, 0);
        d_cameras
    });
    let pixels = count * width as usize * height as usize;
    let values = 3 * pixels;
    let photos = rec.input::<u32>("photos", values.div_ceil(4));
    let targets = rec.scope("loss", |rec| record_targets(rec, photos, values));
    let transforms = exposure.then(|| rec.input::<[f32; EXPOSURE_NUMBERS]>("exposures", count));
    let masks = masked.then(|| rec.input::<u32>("masks", pixels.div_ceil(4)));
    let depth = options.depth_loss.filter(|_| depth).map(|loss| {
        let (targets, weight) = (rec.input::<f32>("depths", pixels), rec.input::<f32>("depth_weight", 1));
        (loss.kind, targets, weight)
    });
    let drawing = match depth {
        Some(_) => &RenderOptions { alpha: true, depth: Some(Depth::Expected), ..*drawing },
        None => drawing,
    };
    let mut learning = None;
    let compare = |rec: &mut Recorder, frames: Tensor| {
        let scale = 1.0 / options.views_per_step as f32;
        let split = depth.map(|(_, targets, _)| DepthFrames::record(rec, [frames, targets], shape));
        let frames = split.map_or(frames, |split| split.colors);
        let exposed = transforms.map(|transforms| Exposed::record(rec, [frames, targets, transforms], shape));
        let frames = exposed.map_or(frames, |exposed| exposed.exposed);
        let frames = masks.map_or(frames, |masks| record_mask(rec, frames, Some(targets), masks, pixels));
        let LossTensors { value, d_frames } = record_loss(rec, options.loss, frames, targets, shape, COLORS, scale);
        rec.output(value);
        let perceptual =
            lpips.and_then(|lpips| record_perceptual(rec, lpips, options, [frames, targets, d_frames], shape));
        perceptual.iter().for_each(|(_, value)| rec.output(*value));
        let d_frames = masks.map_or(d_frames, |masks| record_mask(rec, d_frames, None, masks, pixels));
        let exposures = exposed.zip(transforms).map(|(exposed, transforms)| {
            let d_transforms = exposed.record_backward(rec, d_frames);
            rec.output(d_transforms);
            [transforms, d_transforms]
        });
        let depths = split.zip(depth).map(|(split, (kind, targets, weight))| {
            let [value, d_frames] = split.record_backward(rec, d_frames, weight, kind);
            rec.output(value);
            (DepthTensors { targets, weight, share: scale, value }, d_frames)
        });
        let (depth, d_frames) = depths.map_or((None, d_frames), |(depth, d_frames)| (Some(depth), d_frames));
        learning =
            Some(Learning { dropout_key, photos, masks, losses: value, perceptual, d_cameras, exposures, depth });
        d_frames
    };
    let gradients = Gradients { cameras: d_cameras, ..*gradients };
    let inputs = FrameInputs { scene, cameras, shape, options: drawing, capacity };
    let (outputs, _) = inputs.record_with_gradients(rec, compare, &gradients);
    d_cameras.iter().for_each(|tensor| rec.output(*tensor));
    Recorded { cameras, learning, outputs }
}

/// Records LPIPS of one picture and adds its gradient to `d_frames`, unless the picture is too
/// small.
fn record_perceptual(
    rec: &mut Recorder,
    lpips: &Lpips,
    options: &RefineOptions,
    [frames, targets, d_frames]: [Tensor; 3],
    FrameShape { cameras, width, height }: FrameShape,
) -> Option<(f32, Tensor)> {
    let PerceptualLoss { weight, network } = options.perceptual_loss?;
    assert_eq!(cameras, 1, "photos are learnt from one after the other");
    if width.min(height) < network.least_side() {
        return None;
    }
    let pictures = LpipsPictures {
        pictures: [(frames, COLORS), (targets, COLORS)],
        size: [height as usize, width as usize],
        clipped: true,
    };
    let share = weight / options.views_per_step as f32;
    Some((weight, lpips.record(rec, pictures, Some((share, d_frames))).value))
}

impl PhotoPlan {
    pub fn write(&mut self, views: &[&View], StepInputs { depth_weight, dropout_key: bits }: StepInputs) -> Result<()> {
        let cameras: Vec<CameraRows> = views.iter().map(|view| camera_rows(&view.camera)).collect();
        self.run.write(self.recorded.cameras, &cameras)?;
        if let Some(Learning { dropout_key, photos, masks, exposures, depth, .. }) = self.recorded.learning {
            if let Some(key) = dropout_key {
                self.run.write(key, &[bits])?;
            }
            let bytes: Vec<&[u8]> = views.iter().map(|view| view.image.rgb.as_slice()).collect();
            self.run.write(photos, &bytes.concat())?;
            if let Some(masks) = masks {
                let bytes: Vec<_> = views.iter().map(|view| view.image.mask_or_all()).collect();
                self.run.write(masks, &bytes.concat())?;
            }
            if let Some([transforms, _]) = exposures {
                self.run.write(transforms, &views.iter().map(|view| view.exposure.0).collect::<Vec<_>>())?;
            }
            if let Some(DepthTensors { targets, weight, share, .. }) = depth {
                let unknown = |view: &&View| vec![0.0; view.size[0] as usize * view.size[1] as usize];
                let of = |view: &&View| view.depth.as_ref().map_or_else(|| unknown(view), |depth| depth.to_vec());
                self.run.write(targets, &views.iter().map(of).collect::<Vec<_>>().concat())?;
                self.run.write(weight, &[share * depth_weight])?;
            }
        }
        Ok(())
    }

    pub fn losses(&self, views: &[&View], depth_weight: f32) -> Result<Vec<PhotoLoss>> {
        let Learning { losses, perceptual, d_cameras, exposures, depth, .. } =
            self.recorded.learning.expect("it learns");
        let mut losses: Vec<f32> = self.run.read(losses)?;
        if let Some((weight, value)) = perceptual {
            losses[0] += weight * self.run.read::<f32>(value)?[0];
        }
        if let Some(DepthTensors { value, .. }) = depth {
            let values: Vec<f32> = self.run.read(value)?;
            losses.iter_mut().zip(values).for_each(|(loss, value)| *loss += depth_weight * value);
        }
        let d_cameras: Option<Vec<[f32; CAMERA_NUMBERS]>> =
            d_cameras.map(|tensor| self.run.read(tensor)).transpose()?;
        let d_exposures: Option<Vec<_>> = exposures.map(|[_, tensor]| self.run.read(tensor)).transpose()?;
        let of = |(i, view): (usize, &&View)| PhotoLoss {
            photo: view.photo,
            loss: losses[i],
            d_pose: d_cameras.as_ref().map(|all| std::array::from_fn(|k| all[i][k])),
            d_exposure: d_exposures.as_ref().map(|all| all[i]),
        };
        Ok(views.iter().enumerate().map(of).collect())
    }
}
