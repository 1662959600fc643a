//! Checked arguments of a refinement.

use super::{
    super::{
        camera::{read_cameras, zs_camera},
        image::zs_image,
        pointers::{
            Versioned, checked_array, meaning, optional_text, read_array, read_versioned, write_array, write_versioned,
        },
        progress::{Reporter, zs_progress, zs_progress_action},
        status::Failure,
    },
    zs_refine_options, zs_refine_result,
};
use std::{
    borrow::Cow,
    cell::Cell,
    hash::{DefaultHasher, Hash, Hasher},
    ops::ControlFlow,
};
use zipsplat::{
    Camera, Error, Image, RefineOptions, RefineResult,
    refine::{Photos, RefineCheckpoint, RefineProgress},
    types::ColorTransform,
};

/// Checked arguments.
pub(super) struct Inputs {
    photos: Photographs,
    cameras: Vec<Camera>,
    pub refines_tokens: bool,
    options: zs_refine_options,
    engine: RefineOptions,
}

/// Images with their known depth, if it is used.
pub(super) struct Photographs {
    images: Vec<Image>,
    depths: Vec<Option<Vec<f32>>>,
}

impl Photographs {
    fn identity(&self) -> String {
        let mut hasher = DefaultHasher::new();
        self.images.iter().for_each(|Image { rgb, mask, .. }| (rgb, mask).hash(&mut hasher));
        let bytes = |depth: &Option<Vec<f32>>| depth.as_deref().map(bytemuck::cast_slice::<f32, u8>).hash(&mut hasher);
        self.depths.iter().for_each(bytes);
        format!("{:016x}", hasher.finish())
    }
}

impl Photos for &Photographs {
    fn count(&self) -> usize {
        self.images.count()
    }

    fn size(&self, i: usize) -> [u32; 2] {
        self.images.size(i)
    }

    fn open(&self, i: usize) -> Result<Cow<'_, Image>, Error> {
        self.images.open(i)
    }

    fn depth(&self, i: usize) -> Result<Option<Cow<'_, [f32]>>, Error> {
        Ok(self.depths.get(i).and_then(Option::as_deref).map(Cow::Borrowed))
    }
}

pub(super) type ProgressFunction<'a> = &'a mut dyn FnMut(RefineProgress<'_>) -> ControlFlow<()>;

impl Inputs {
    /// # Safety
    /// Arrays have `count` elements, structures their stated sizes; all may be NULL.
    pub unsafe fn read(
        images: *const zs_image,
        cameras: *const zs_camera,
        count: usize,
        options: *const zs_refine_options,
        result: *mut zs_refine_result,
    ) -> Result<Self, Failure> {
        if count == 0 {
            return Err(Failure::argument("number of images", count, "at least 1"));
        }
        // SAFETY: the caller's promise. Outputs are checked before expensive work.
        let (images, cameras, options) = unsafe {
            let output = read_versioned(result)?.cameras;
            checked_array(output, if output.is_null() { 0 } else { count }, "cameras")?;
            (read_array(images, count, "images")?, read_cameras(cameras, count)?, read_versioned(options)?)
        };
        let refines_tokens = meaning("target", options.target, "zs_refine_target", [false, true])?;
        let mut engine = options.engine()?;
        let photo = |(i, image): (usize, &zs_image)| {
            // SAFETY: the caller's pixels.
            unsafe { image.image(&format!("image {i}")) }
        };
        let pictures = images.iter().enumerate().map(photo).collect::<Result<_, _>>()?;
        let depth = |image: &zs_image| {
            // SAFETY: the caller's array.
            unsafe { image.known_depth() }
        };
        let depths: Vec<Option<Vec<f32>>> = match engine.depth_loss {
            Some(_) => images.iter().map(depth).collect::<Result<_, _>>()?,
            None => Vec::new(),
        };
        if engine.depth_loss.is_some() && depths.iter().all(Option::is_none) {
            let expected = "that of some image, for depth_loss";
            return Err(Failure::argument("depth of the images", "NULL in all", expected));
        }
        let photos = Photographs { images: pictures, depths };
        // SAFETY: the caller's text.
        let checkpoint = unsafe { optional_text(options.checkpoint, "checkpoint")? };
        engine.checkpoint = checkpoint.map(|path| RefineCheckpoint::new(path.into(), photos.identity()));
        Ok(Self { photos, cameras, refines_tokens, options, engine })
    }

    pub fn run(
        &self,
        refine: impl FnOnce(&Photographs, &[Camera], &RefineOptions, ProgressFunction<'_>) -> Result<RefineResult, Error>,
    ) -> Result<RefineResult, Error> {
        let reporter = Reporter { callback: self.options.progress, user_data: self.options.user_data };
        let is_cancelled = Cell::new(false);
        let mut progress = |now: RefineProgress<'_>| match reporter.report("refine", of(&now)) {
            zs_progress_action::ZS_CONTINUE => ControlFlow::Continue(()),
            action => {
                is_cancelled.set(action == zs_progress_action::ZS_CANCEL);
                ControlFlow::Break(())
            }
        };
        let found = refine(&self.photos, &self.cameras, &self.engine, &mut progress)?;
        if is_cancelled.get() { Err(Error::Cancelled) } else { Ok(found) }
    }

    /// # Safety
    /// As [`Inputs::read`].
    pub unsafe fn write(&self, result: *mut zs_refine_result, found: &RefineResult) -> Result<(), Failure> {
        if result.is_null() {
            return Ok(());
        }
        // SAFETY: checked in `read`.
        unsafe {
            let zs_refine_result { cameras, exposures, .. } = read_versioned(result)?;
            write_versioned(result, zs_refine_result { cameras, exposures, ..found.into() })?;
            if !exposures.is_null() {
                let identity = vec![ColorTransform::IDENTITY; self.cameras.len()];
                let transforms = found.exposures.as_ref().unwrap_or(&identity);
                let numbers: Vec<f32> = transforms.iter().flat_map(|transform| transform.0.concat()).collect();
                std::ptr::copy_nonoverlapping(numbers.as_ptr(), exposures, numbers.len());
            }
            if cameras.is_null() { Ok(()) } else { write_array(cameras, found.cameras.iter().map(zs_camera::from)) }
        }
    }
}

fn of(now: &RefineProgress<'_>) -> zs_progress {
    zs_progress {
        fraction: now.step as f64 / now.steps.max(1) as f64,
        step: now.step,
        steps: now.steps,
        loss: now.loss.into(),
        psnr: now.psnr.unwrap_or(f64::NAN),
        eta_seconds: now.eta.as_secs_f64(),
        ..Versioned::new()
    }
}
