//! Comparison of pictures; failures are saved as PNG.

use std::path::{Path, PathBuf};
use std::{env, fs};

use super::{Float, Tolerance};
use zipsplat::{gpu::Element, ops::Arithmetic};

/// Limit of the deviation per value, `absolute + relative * |truth|`.
#[derive(Clone, Copy, Debug)]
pub struct ImageTolerance {
    /// In the picture's unit.
    pub absolute: f64,
    pub relative: f64,
    /// In dB against the truth's range; 0 disables it.
    pub psnr: f64,
}

impl ImageTolerance {
    // Twice the worst deviation of gsplat's formulas in f32.

    /// Color and alpha in `[0, 1]`.
    pub const RGB: ImageTolerance = ImageTolerance { absolute: 8e-6, relative: 0.0, psnr: 110.0 };
    /// Accumulated depth, in world units, of a scene a few units deep.
    pub const DEPTH: ImageTolerance = ImageTolerance { absolute: 4e-5, relative: 0.0, psnr: 110.0 };
    /// Expected depth: division by small alphas.
    pub const EXPECTED_DEPTH: ImageTolerance = ImageTolerance { absolute: 6e-5, relative: 0.0, psnr: 110.0 };
    /// Color and alpha of `edge`: inverse covariances are ill-conditioned.
    pub const RGB_EDGE: ImageTolerance = ImageTolerance { absolute: 1.5e-4, relative: 0.0, psnr: 90.0 };
    /// Depths of `edge`, up to a thousand units.
    pub const DEPTH_EDGE: ImageTolerance = ImageTolerance { absolute: 2e-4, relative: 2e-4, psnr: 80.0 };
    /// f64 against truth stored in f32.
    pub const STORED: ImageTolerance = ImageTolerance { absolute: 1e-7, relative: 1e-7, psnr: 140.0 };

    /// Returns the tolerance of a faster arithmetic. Gaussians of similar depth may swap: single
    /// pixels are unbounded.
    pub fn of_network(arithmetic: Arithmetic) -> Self {
        let coarser = Tolerance::factor_rounding(arithmetic) / Element::F16.roundoff();
        Self { absolute: f64::INFINITY, relative: 0.0, psnr: 45.0 - 20.0 * coarser.log10() }
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Picture<'a, T> {
    pub values: &'a [T],
    pub width: usize,
    /// 1 (alpha, depth) or 3 (RGB).
    pub channels: usize,
}

/// Returns the PSNR in dB of the compared pixels; failures save the pictures and the difference.
/// Nonzero `unstable` pixels (`&[]` for none) only need to be finite.
#[track_caller]
pub fn assert_images_close<G: Float, T: Float>(
    name: &str,
    got: Picture<G>,
    truth: &[T],
    unstable: &[u8],
    tolerance: ImageTolerance,
) -> f64 {
    let values: Vec<f64> = got.values.iter().map(|&x| x.into()).collect();
    let truth: Vec<f64> = truth.iter().map(|&x| x.into()).collect();
    match measure(&values, &truth, got.channels, unstable, tolerance) {
        Ok(psnr) => psnr,
        Err(problem) => {
            let saved = match save(name, &values, &truth, got.width, got.channels) {
                Ok(paths) => paths.iter().map(|path| format!("\n  {}", path.display())).collect(),
                Err(error) => format!("\n  (not saved: {error})"),
            };
            panic!("{name}: {problem}{saved}");
        }
    }
}

fn measure(
    got: &[f64],
    truth: &[f64],
    channels: usize,
    unstable: &[u8],
    tolerance: ImageTolerance,
) -> Result<f64, String> {
    if got.len() != truth.len() {
        return Err(format!("{} values, truth has {}", got.len(), truth.len()));
    }
    if !unstable.is_empty() && unstable.len() * channels != got.len() {
        return Err(format!("{} values for {} marks of unstable pixels", got.len(), unstable.len()));
    }
    let (mut sum2, mut compared, mut wrong) = (0.0, 0usize, Vec::new());
    for (i, (&got, &truth)) in got.iter().zip(truth).enumerate() {
        if !got.is_finite() || !truth.is_finite() {
            return Err(format!("value {i} is {got}, truth is {truth}"));
        }
        if unstable.get(i / channels).is_some_and(|&mark| mark != 0) {
            continue;
        }
        let err = (got - truth).abs();
        if err > tolerance.absolute + tolerance.relative * truth.abs() {
            wrong.push((err, i));
        }
        sum2 += err * err;
        compared += 1;
    }
    let peak = truth.iter().fold(1.0f64, |peak, x| peak.max(x.abs()));
    let psnr = 10.0 * (peak * peak * compared.max(1) as f64 / sum2.max(f64::MIN_POSITIVE)).log10();
    if let Some(&(err, i)) = wrong.iter().max_by(|a, b| a.0.total_cmp(&b.0)) {
        let (pixel, channel) = (i / channels, i % channels);
        return Err(format!(
            "{} of {compared} values deviate, most at pixel {pixel} channel {channel}: {}, truth {}, apart {err:.2e} ({tolerance:?}); {psnr:.1} dB",
            wrong.len(),
            got[i],
            truth[i]
        ));
    }
    if psnr < tolerance.psnr {
        return Err(format!("{psnr:.1} dB, at least {:.1} asked for", tolerance.psnr));
    }
    Ok(psnr)
}

fn save(
    name: &str,
    got: &[f64],
    truth: &[f64],
    width: usize,
    channels: usize,
) -> Result<[PathBuf; 3], Box<dyn std::error::Error>> {
    let target = env::var_os("CARGO_TARGET_DIR").map(PathBuf::from);
    let target = target.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../target"));
    let folder = target.join("failed-images");
    fs::create_dir_all(&folder)?;
    let stem: String = name.chars().map(|c| if c.is_alphanumeric() || c == '.' { c } else { '_' }).collect();

    let largest = |values: &[f64]| values.iter().filter(|x| x.is_finite()).fold(0.0f64, |a, x| a.max(x.abs()));
    let range = largest(truth).max(1.0);
    let difference: Vec<f64> = got.iter().zip(truth).map(|(got, truth)| (got - truth).abs()).collect();
    let pictures = [
        ("got", got, range),
        ("truth", truth, range),
        ("difference", difference.as_slice(), largest(&difference).max(f64::MIN_POSITIVE)),
    ];
    let mut paths = Vec::new();
    for (what, values, white) in pictures {
        // Non-finite values are white.
        let byte = |x: &f64| if x.is_finite() { (x / white * 255.0).round().clamp(0.0, 255.0) as u8 } else { 255 };
        let bytes: Vec<u8> = values.iter().map(byte).collect();
        let height = bytes.len() / (width * channels);
        let color = if channels == 3 { image::ColorType::Rgb8 } else { image::ColorType::L8 };
        let path = folder.join(format!("{stem}.{what}.png"));
        image::save_buffer(&path, &bytes[..height * width * channels], width as u32, height as u32, color)?;
        paths.push(path);
    }
    Ok(paths.try_into().expect("three pictures"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOLERANCE: ImageTolerance = ImageTolerance { absolute: 1e-3, relative: 0.0, psnr: 0.0 };

    #[test]
    fn unstable_pixels_are_left_out_but_must_be_finite() {
        let truth = [0.5f64; 6];
        let got = |value: f64| [0.5, 0.5, 0.5, value, 0.5, 0.5];
        assert!(measure(&got(0.9), &truth, 3, &[0, 1], TOLERANCE).unwrap() > 100.0);
        assert!(measure(&got(0.9), &truth, 3, &[], TOLERANCE).is_err());
        assert!(measure(&got(0.9), &truth, 3, &[1, 0], TOLERANCE).is_err());
        assert!(measure(&got(f64::NAN), &truth, 3, &[0, 1], TOLERANCE).is_err());
    }

    #[test]
    fn a_failure_saves_three_pictures_and_names_them() {
        let (got, truth) = ([0.0f32, 0.25, 0.5, f32::NAN], [0.0f32, 0.25, 0.25, 0.0]);
        let picture = Picture { values: &got, width: 2, channels: 1 };
        let caught = std::panic::catch_unwind(|| {
            assert_images_close("compare self-test", picture, &truth, &[], TOLERANCE);
        });
        let message = caught.unwrap_err().downcast_ref::<String>().unwrap().clone();
        for path in message.lines().skip(1).map(|line| Path::new(line.trim())) {
            assert_eq!(image::open(path).unwrap().to_luma8().dimensions(), (2, 2));
            fs::remove_file(path).unwrap();
        }
        assert_eq!(message.lines().count(), 4, "{message}");
    }
}
