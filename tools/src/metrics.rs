//! Image similarity: PSNR and SSIM as in scikit-image's `skimage.metrics`, and LPIPS.

use clap::{Args, ValueEnum};
use std::path::{Path, PathBuf};
use zipsplat::{
    Device, Error, Result,
    perceptual::Perceptual,
    stages::lpips::LpipsNetwork,
    types::{Image, MASKED},
};

/// Standard deviation of SSIM's window, in pixels.
const SIGMA: f64 = 1.5;
const RADIUS: usize = 5;
const PIXELS: f64 = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f64;

pub fn values(image: &Image) -> Vec<f32> {
    image.rgb.iter().map(|value| f32::from(*value) / 255.0).collect()
}

/// Returns dB, for values in 0..1; infinite for equal pictures.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let squares: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    -10.0 * (squares / a.len() as f64).log10()
}

pub fn mean_color(picture: &[f32]) -> Vec<f32> {
    let mut sums = [0.0; 3];
    picture.iter().enumerate().for_each(|(i, value)| sums[i % 3] += f64::from(*value));
    (0..picture.len()).map(|i| (sums[i % 3] * 3.0 / picture.len() as f64) as f32).collect()
}

/// Structural similarity of two `[height][width][rgb]` pictures in 0..1 (Wang et al. 2004).
///
/// Matches scikit-image's `structural_similarity(a, b, win_size=11, data_range=1, channel_axis=-1,
/// gaussian_weights=True)`: mean over channels and complete windows, K1 = 0.01, K2 = 0.03, sample
/// variances.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
    ssim_where(a, b, [width, height], |_| true)
}

/// SSIM of pictures that are gray where the mask of `image` ignores pixels, over the windows whose
/// center it keeps. `b` are its values.
pub fn masked_ssim(image: &Image, a: &[f32], b: &[f32]) -> f64 {
    let [a, b] = hidden(image, a, b);
    ssim_where(&a, &b, [image.width as usize, image.height as usize], |center| !image.ignores(center))
}

pub fn hidden(image: &Image, a: &[f32], b: &[f32]) -> [Vec<f32>; 2] {
    let mut pictures = [a, b].map(<[f32]>::to_vec);
    pictures.iter_mut().for_each(|picture| image.hide(picture, f32::from(MASKED) / 255.0));
    pictures
}

fn ssim_where(a: &[f32], b: &[f32], [width, height]: [usize; 2], counts: impl Fn(usize) -> bool) -> f64 {
    assert!(a.len() == 3 * width * height && b.len() == a.len() && width.min(height) > 2 * RADIUS);
    let mean = |value: &dyn Fn(f64, f64) -> f64, channel: usize| {
        let values = (0..width * height).map(|i| value(f64::from(a[3 * i + channel]), f64::from(b[3 * i + channel])));
        filter(&values.collect::<Vec<_>>(), width)
    };
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let of_sample = PIXELS / (PIXELS - 1.0);
    let mut sum = 0.0;
    let mut count = 0;
    for channel in 0..3 {
        let (mean_a, mean_b) = (mean(&|a, _| a, channel), mean(&|_, b| b, channel));
        let (aa, bb, ab) = (mean(&|a, _| a * a, channel), mean(&|_, b| b * b, channel), mean(&|a, b| a * b, channel));
        let inside = width - 2 * RADIUS;
        let centers = (0..mean_a.len()).map(|i| (i / inside + RADIUS) * width + i % inside + RADIUS);
        for (i, _) in centers.enumerate().filter(|(_, center)| counts(*center)) {
            count += 1;
            let (a, b) = (mean_a[i], mean_b[i]);
            let [variances, covariance] = [aa[i] - a * a + bb[i] - b * b, ab[i] - a * b].map(|value| of_sample * value);
            sum += (2.0 * a * b + c1) * (2.0 * covariance + c2) / ((a * a + b * b + c1) * (variances + c2));
        }
    }
    sum / count as f64
}

/// Gaussian-weighted means of complete windows.
fn filter(values: &[f64], width: usize) -> Vec<f64> {
    let taps: [f64; 2 * RADIUS + 1] =
        std::array::from_fn(|i| (-0.5 * ((i as f64 - RADIUS as f64) / SIGMA).powi(2)).exp());
    let total: f64 = taps.iter().sum();
    let along = |window: &mut dyn Iterator<Item = f64>| window.zip(taps).map(|(v, tap)| v * tap).sum::<f64>() / total;
    let rows = values.chunks_exact(width);
    let narrow: Vec<f64> =
        rows.flat_map(|row| row.windows(taps.len()).map(|window| along(&mut window.iter().copied()))).collect();
    let width = width - 2 * RADIUS;
    let starts = 0..narrow.len() - 2 * RADIUS * width;
    starts.map(|start| along(&mut narrow[start..].iter().step_by(width).copied())).collect()
}

#[derive(Args, Debug)]
pub(crate) struct LpipsOption {
    /// Network of LPIPS; `python3 tools/lpips.py` downloads its weights [default: vgg if available,
    /// else none; with --protocol vgg]
    #[arg(long, value_enum, value_name = "NETWORK")]
    pub lpips: Option<Network>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Network {
    /// VGG16, as in the paper
    Vgg,
    /// AlexNet, ten times as fast
    Alex,
    /// No LPIPS
    None,
}

impl LpipsOption {
    /// Finds the weights; `None` if they are missing and neither requested nor `required`.
    pub fn file(&self, cache: Option<&Path>, required: bool) -> Result<Option<(LpipsNetwork, PathBuf)>> {
        let network = match self.lpips {
            Some(Network::None) => return Ok(None),
            Some(Network::Alex) => LpipsNetwork::Alex,
            Some(Network::Vgg) | None => LpipsNetwork::Vgg,
        };
        match Perceptual::file(network, cache) {
            Ok(path) => Ok(Some((network, path))),
            Err(error) if self.lpips.is_some() => Err(error),
            Err(error) if required => {
                Err(Error::argument("--lpips", format!("no weights ({error})"), "its weights, or --lpips none"))
            }
            Err(_) => Ok(None),
        }
    }

    /// Opens [`LpipsOption::file`], with `gradients` or for the distance alone.
    pub fn open(&self, device: &Device, gradients: bool, required: bool) -> Result<Option<Perceptual>> {
        let found = self.file(device.cache_dir(), required)?;
        found.map(|(network, path)| Perceptual::open(device, network, &path, gradients)).transpose()
    }
}

/// LPIPS of a picture and `image`, both gray where its mask ignores pixels, per kept fraction;
/// `None` without a network, or if the pictures, `[height][width][rgb]` in 0..1, are too small.
pub fn masked_lpips(network: Option<&mut Perceptual>, image: &Image, picture: &[f32]) -> Result<Option<f64>> {
    let size = [image.width, image.height];
    let Some(network) = network.filter(|network| size[0].min(size[1]) >= network.network().least_side()) else {
        return Ok(None);
    };
    let [a, b] = hidden(image, picture, &values(image));
    let kept = image.kept(&image.rgb).len() as f64 / image.rgb.len() as f64;
    Ok(Some(network.distance([&a, &b], size)? / kept))
}
