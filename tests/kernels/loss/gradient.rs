use crate::case::*;
use zipsplat::gpu::Recorder;
use zipsplat::stages::FrameShape;
use zipsplat::stages::loss::{Loss, record_loss, record_mask};
use zipsplat_tests::{golden::interleaved, reference::loss::gradient as reference};

const LOSSES: [(Loss, &str); 4] =
    [(Loss::L1, "l1"), (Loss::Mse, "mse"), (Loss::Dssim, "dssim_same"), (Loss::L1Dssim, "l1_dssim_3dgs")];

struct Pictures {
    shape: FrameShape,
    frames: Vec<f32>,
    targets: Vec<f32>,
    /// Empty without masks.
    masks: Vec<u8>,
}

impl Pictures {
    fn random([cameras, width, height]: [usize; 3]) -> Self {
        let len = cameras * width * height * 3;
        let picture = |seed| random(seed, len).iter().map(|x| 0.5 + 0.6 * x).collect();
        let shape = FrameShape { cameras, width: width as u32, height: height as u32 };
        Self { shape, frames: picture(1), targets: picture(2), masks: Vec::new() }
    }

    fn masked(self) -> Self {
        let masks = random(4, self.frames.len() / 3).iter().map(|x| if *x > 0.2 { 0 } else { 255 }).collect();
        Self { masks, ..self }
    }

    fn compared(&self, limits: &Limits, loss: Loss, channels: usize, scale: f32) -> [Vec<f32>; 2] {
        let mut case = plan_within(limits);
        let pixel = |rgb: &[f32]| rgb.iter().copied().chain([7.0; 8]).take(channels).collect::<Vec<_>>();
        let frames = case.input(&self.frames.chunks(3).flat_map(pixel).collect::<Vec<_>>());
        let targets = case.input(&self.targets);
        let words =
            self.masks.chunks(4).map(|four| four.iter().rev().fold(0, |word, byte| word << 8 | u32::from(*byte)));
        let masks = (!self.masks.is_empty()).then(|| case.input(&words.collect::<Vec<_>>()));
        let masked = masks.map(|masks| record_mask(&mut case.rec, frames, Some(targets), masks, self.masks.len()));
        let frames = masked.unwrap_or(frames);
        let found = record_loss(&mut case.rec, loss, frames, targets, self.shape, channels, scale);
        if let Some(masks) = masks {
            record_mask(&mut case.rec, found.d_frames, None, masks, self.masks.len());
        }
        case.results([found.value, found.d_frames]).unwrap()
    }

    fn truth(&self, loss: Loss, scale: f32) -> [Vec<f64>; 2] {
        let width = self.shape.width as usize;
        let values = 3 * width * self.shape.height as usize;
        let pairs = self.frames.chunks(values).zip(self.targets.chunks(values)).enumerate();
        let picture = |(i, (a, b)): (usize, (&[f32], &[f32]))| {
            let mask = self.masks.get(i * values / 3..(i + 1) * values / 3);
            of(loss, &widen(a), &widen(b), width, mask)
        };
        let all: Vec<_> = pairs.map(picture).collect();
        let gradient = all.iter().flat_map(|(_, gradient)| gradient.iter().map(|x| x * f64::from(scale)));
        [all.iter().map(|(value, _)| *value).collect(), gradient.collect()]
    }
}

fn of(loss: Loss, a: &[f64], b: &[f64], width: usize, mask: Option<&[u8]>) -> (f64, Vec<f64>) {
    let of = |a: &[f64], b: &[f64]| match loss {
        Loss::L1 => reference::l1(a, b),
        Loss::Mse => reference::mse(a, b),
        Loss::Dssim => reference::dssim(a, b, width),
        Loss::L1Dssim => reference::l1_dssim(a, b, width),
    };
    mask.map_or_else(|| of(a, b), |mask| reference::masked(of, a, b, mask))
}

#[test]
fn equals_the_goldens() {
    for golden in golden::list("grad_loss").iter().filter_map(|file| Golden::open(file)) {
        for case in golden.stems("/l1/loss") {
            let shape = golden.shape(&format!("{case}/a"));
            let (cameras, height, width) = (shape[0], shape[2] as u32, shape[3] as u32);
            let picture = |key: &str| interleaved(&golden.f32(&format!("{case}/{key}")), shape[2] * shape[3]);
            let shape = FrameShape { cameras, width, height };
            let pictures = Pictures { shape, frames: picture("a"), targets: picture("b"), masks: Vec::new() };
            for (loss, name) in LOSSES {
                let [values, d_frames] = pictures.compared(device().limits(), loss, 3, 1.0 / cameras as f32);
                let name = format!("{} {case}/{name}", golden.file());
                let key = |what: &str| format!("{case}/{}/{what}", name.rsplit('/').next().unwrap());
                let mean = widen(&values).iter().sum::<f64>() / cameras as f64;
                let value = assert_close(&name, &[mean], &golden.f64(&key("loss")), Tolerance::rms(1e-6));
                let truth = interleaved(&golden.f64(&key("d_a")), (width * height) as usize);
                // Variances of flat pictures cancel.
                let tolerance = Tolerance::rms(if case == "flat" { 3e-4 } else { 3e-5 });
                let gradient = assert_close(&format!("{name} d_a"), &d_frames, &truth, tolerance);
                println!("{name}: loss {:.1e}, d_a {:.1e}", value.rms, gradient.rms);
            }
        }
    }
}

#[test]
fn equals_the_reference() {
    for size in [[1, 1, 1], [1, 3, 2], [2, 8, 16], [3, 11, 5], [1, 40, 23], [5, 7, 9]] {
        let pictures = [Pictures::random(size), Pictures::random(size).masked()];
        for (pictures, (loss, name)) in pictures.iter().flat_map(|pictures| LOSSES.map(|loss| (pictures, loss))) {
            let got = pictures.compared(device().limits(), loss, 3, 0.3);
            let truth = pictures.truth(loss, 0.3);
            assert_close(&format!("{name} of {size:?}"), &got[0], &truth[0], Tolerance::rms(1e-6));
            assert_close(&format!("gradient of {name} of {size:?}"), &got[1], &truth[1], Tolerance::rms(3e-5));
        }
    }
}

#[test]
fn equal_pictures_lose_nothing() {
    let mut pictures = Pictures::random([2, 20, 13]);
    pictures.frames = pictures.targets.clone();
    for (loss, name) in LOSSES {
        let [values, d_frames] = pictures.compared(device().limits(), loss, 3, 1.0);
        assert_same(name, &values, &[0.0; 2]);
        assert_same(&format!("gradient of {name}"), &d_frames, &vec![0.0; 2 * 20 * 13 * 3]);
    }
}

#[test]
fn other_channels_have_no_gradient() {
    let pictures = Pictures::random([2, 9, 14]);
    for (loss, name) in LOSSES {
        let [values, d_frames] = pictures.compared(device().limits(), loss, 3, 1.0);
        let [same, wide] = pictures.compared(device().limits(), loss, 5, 1.0);
        assert_same(name, &same, &values);
        let widened: Vec<f32> = d_frames.chunks(3).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 0.0, 0.0]).collect();
        assert_same(&format!("gradient of {name}"), &wide, &widened);
    }
}

#[test]
fn parts_give_the_same_bits() {
    // 16 x 16 pixels: the moments of one picture are 12 KiB.
    let narrow = Limits { max_binding_bytes: 40 << 10, ..device().limits().clone() };
    let pictures = [Pictures::random([9, 16, 16]), Pictures::random([9, 16, 16]).masked()];
    for (pictures, (loss, name)) in pictures.iter().flat_map(|pictures| LOSSES.map(|loss| (pictures, loss))) {
        let [got, truth] = [&narrow, device().limits()].map(|limits| pictures.compared(limits, loss, 3, 1.0));
        assert_same(name, &got[0], &truth[0]);
        assert_same(&format!("gradient of {name}"), &got[1], &truth[1]);
    }
}

#[test]
fn the_reference_has_the_gradient_of_its_value() {
    let pictures = Pictures::random([1, 9, 12]).masked();
    let (a, b) = (widen(&pictures.frames), widen(&pictures.targets));
    let direction = widen(&random(3, a.len()));
    for (mask, (loss, name)) in
        [None, Some(&pictures.masks[..])].into_iter().flat_map(|mask| LOSSES.map(|loss| (mask, loss)))
    {
        let moved =
            |step: f64| of(loss, &a.iter().zip(&direction).map(|(a, d)| a + step * d).collect::<Vec<_>>(), &b, 9, mask);
        let difference = (moved(1e-6).0 - moved(-1e-6).0) / 2e-6;
        let slope: f64 = moved(0.0).1.iter().zip(&direction).map(|(g, d)| g * d).sum();
        assert!((difference - slope).abs() < 1e-6 * slope.abs(), "{name}: {slope}, by differences {difference}");
    }
}

#[test]
fn parts_of_large_masks_begin_where_bindings_may() {
    let (mut rec, pixels) = (Recorder::new(device().limits()), 6000 * 4000);
    let [frames, targets] = ["frames", "targets"].map(|name| rec.tensor::<f32>(name, 3 * pixels));
    let masks = rec.tensor::<u32>("masks", pixels / 4);
    record_mask(&mut rec, frames, Some(targets), masks, pixels);
}

#[test]
fn masked_pixels_have_neither_influence_nor_gradient() {
    let pictures = Pictures::random([2, 9, 14]).masked();
    let hidden = |i: usize| pictures.masks[i / 3] == 0;
    let frames = pictures.frames.iter().enumerate().map(|(i, x)| if hidden(i) { f32::NAN } else { *x }).collect();
    let other = Pictures { frames, targets: pictures.targets.clone(), masks: pictures.masks.clone(), ..pictures };
    for (loss, name) in LOSSES {
        let [got, truth] = [&other, &pictures].map(|pictures| pictures.compared(device().limits(), loss, 3, 1.0));
        assert_same(name, &got[0], &truth[0]);
        assert_same(&format!("gradient of {name}"), &got[1], &truth[1]);
        assert!(got[1].iter().enumerate().all(|(i, gradient)| !hidden(i) || *gradient == 0.0), "{name}");
    }
}
