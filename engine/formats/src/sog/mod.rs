//! PlayCanvas's SOG, version 2: a ZIP archive of `meta.json` and lossless WebP images with a pixel
//! per Gaussian. Axes as in PLY.
//!
//! Resolution: positions 2⁻¹⁶ of the logarithmic range per axis; rotations 0.003 per component;
//! opacities 1/510. Log scales, colors and higher coefficients are indices into codebooks of 256
//! values. Higher coefficients first go to a palette of at most 65,536 entries.

mod palette;

use std::io::{Cursor, Read, Write};

use image::{ExtendedColorType, ImageReader, codecs::webp::WebPEncoder};
use serde::{Deserialize, Deserializer};
use serde_json::{Value, json};
use zip::{CompressionMethod, ZipArchive, ZipWriter, write::SimpleFileOptions};

use super::format::{Encoder, Format, SaveOptions};
use super::{Scene, World, camera::unit_quaternion, source::Source};
use crate::{Error, Result};
use palette::Palette;

pub(super) const FORMAT: Format = Format {
    marks: &[],
    view_dependence: true,
    antialiased: true,
    order: Some(order),
    read: read_unchecked,
    world: Some(read_line),
    write: encoder,
};

const VERSION: u32 = 2;
const CODES: usize = 256;
const MAX_PALETTE: usize = 1 << 16;
/// Gaussians per palette entry.
const SHARED: usize = 4;
const LEAST_PALETTE: usize = 1024;
/// Palette entries per row of the image.
const COLUMNS: usize = 64;
/// The logarithm of 0 is infinite.
const MIN_SCALE: f32 = 1e-9;
const META: &str = "meta.json";
const ANTIALIASED: &str = "antialiased";
const MAX_META: u64 = 1 << 20;
const MAX_IMAGE: u64 = 1 << 30;

#[derive(Deserialize)]
struct Meta {
    count: usize,
    model: Option<String>,
    /// Instead of `model` in the specification.
    #[serde(default)]
    antialias: bool,
    means: Means,
    scales: Coded,
    quats: Plain,
    sh0: Coded,
    #[serde(rename = "shN")]
    sh_rest: Option<Rest>,
    #[serde(default)]
    asset: Value,
}

#[derive(Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct Coded {
    #[serde(deserialize_with = "codes")]
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct Plain {
    files: [String; 1],
}

#[derive(Deserialize)]
struct Rest {
    count: usize,
    bands: u32,
    #[serde(deserialize_with = "codes")]
    codebook: Vec<f32>,
    files: [String; 2],
}

/// Early splat-transform writes `null` for the first code; PlayCanvas extrapolates it.
fn codes<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<Vec<f32>, D::Error> {
    let found = Vec::<Option<f32>>::deserialize(from)?;
    let first = match found[..] {
        [None, Some(second), .., Some(last)] => second + (second - last) / 255.0,
        _ => f32::NAN,
    };
    Ok(found.iter().enumerate().map(|(i, code)| code.unwrap_or(if i == 0 { first } else { f32::NAN })).collect())
}

struct Texels {
    width: usize,
    rgba: Vec<[u8; 4]>,
}

fn webp(width: usize, mut rgba: Vec<[u8; 4]>) -> std::io::Result<Vec<u8>> {
    let height = rgba.len().div_ceil(width).max(1).next_multiple_of(4);
    rgba.resize(width * height, [0, 0, 0, 255]);
    let mut bytes = Vec::new();
    let encoder = WebPEncoder::new_lossless(&mut bytes);
    let encoded = encoder.encode(rgba.as_flattened(), width as u32, height as u32, ExtendedColorType::Rgba8);
    encoded.map_err(std::io::Error::other)?;
    Ok(bytes)
}

/// Morton order: neighbors in space become neighbors in the images.
fn order(scene: &Scene) -> Vec<usize> {
    let (low, high) = bounds(scene, |x| x);
    let code = |i: &usize| {
        (0..3).fold(0u64, |code, axis| {
            let extent = (high[axis] - low[axis]).max(f64::MIN_POSITIVE);
            let place = ((f64::from(scene.means[*i][axis]) - low[axis]) / extent * 1023.0) as u64;
            (0..10).fold(code, |code, bit| code | (place >> bit & 1) << (3 * bit + axis as u64))
        })
    };
    let mut order: Vec<usize> = (0..scene.len()).collect();
    order.sort_by_cached_key(code);
    order
}

fn bounds(scene: &Scene, map: impl Fn(f64) -> f64) -> ([f64; 3], [f64; 3]) {
    let axis = |axis: usize| scene.means.iter().map(move |mean| f64::from(mean[axis])).map(&map);
    let end = |axis_of: usize, pick: fn(f64, f64) -> f64| axis(axis_of).reduce(pick).unwrap_or_default();
    ([0, 1, 2].map(|a| end(a, f64::min)), [0, 1, 2].map(|a| end(a, f64::max)))
}

fn log(x: f64) -> f64 {
    x.signum() * x.abs().ln_1p()
}

fn unlog(x: f64) -> f64 {
    x.signum() * x.abs().exp_m1()
}

fn encoder<'a>(scene: &'a Scene, _: &SaveOptions, world: Option<&World>) -> Result<Encoder<'a>> {
    let generator = World::line(world);
    Ok(Box::new(move |out| {
        let mut bytes = Cursor::new(Vec::new());
        let mut zip = ZipWriter::new(&mut bytes);
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        for (name, content) in encode(scene, &generator)? {
            zip.start_file(name, options)?;
            zip.write_all(&content)?;
        }
        zip.finish()?;
        out.write_all(bytes.get_ref())
    }))
}

/// Returns the files by name.
fn encode(scene: &Scene, generator: &str) -> std::io::Result<Vec<(&'static str, Vec<u8>)>> {
    let n = scene.len();
    let width = n.isqrt().max(1).next_multiple_of(4);
    let (mins, maxs) = bounds(scene, log);
    let mean = |i: usize| {
        std::array::from_fn::<u16, 3, _>(|axis| {
            let extent = (maxs[axis] - mins[axis]).max(f64::MIN_POSITIVE);
            ((log(scene.means[i][axis].into()) - mins[axis]) / extent * 65535.0).round() as u16
        })
    };
    let byte = |of: fn(u16) -> u8| (0..n).map(|i| rgb(mean(i).map(of))).collect::<Vec<_>>();
    let logs: Vec<f32> = scene.scales.as_flattened().iter().map(|scale| scale.max(MIN_SCALE).ln()).collect();
    let k = scene.sh_coeffs_per_gaussian();
    let base: Vec<f32> = scene.sh_coeffs.iter().step_by(k).flatten().copied().collect();
    let (scales, colors) = (Palette::of(&logs, 1, CODES), Palette::of(&base, 1, CODES));
    let codes = |palette: &Palette| -> Vec<[u8; 3]> {
        palette.labels.as_chunks().0.iter().map(|labels: &[u16; 3]| labels.map(|label| label as u8)).collect()
    };
    let alpha = scene.opacities.iter().map(|opacity| (255.0 * opacity).round() as u8);
    let color = codes(&colors).into_iter().zip(alpha).map(|([r, g, b], a)| [r, g, b, a]).collect();
    let mut images = vec![
        ("means_l.webp", width, byte(|x| x as u8)),
        ("means_u.webp", width, byte(|x| (x >> 8) as u8)),
        ("scales.webp", width, codes(&scales).into_iter().map(rgb).collect()),
        ("quats.webp", width, scene.quats.iter().map(|quat| pack(*quat)).collect()),
        ("sh0.webp", width, color),
    ];
    let mut meta = json!({
        "version": VERSION, "asset": { "generator": generator }, "count": n,
        "means": { "mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": padded(scales.centers), "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": padded(colors.centers), "files": ["sh0.webp"] },
    });
    if scene.antialiased {
        meta["model"] = ANTIALIASED.into();
    }
    if k > 1 && n > 0 {
        let rest: Vec<f32> =
            scene.sh_coeffs.chunks_exact(k).flat_map(|coeffs| coeffs[1..].as_flattened()).copied().collect();
        let palette = Palette::of(&rest, 3 * (k - 1), (n / SHARED).clamp(LEAST_PALETTE, MAX_PALETTE));
        let values = Palette::of(&palette.centers, 1, CODES);
        let label = |label: &u16| [*label as u8, (label >> 8) as u8, 0, 255];
        images.push(("shN_centroids.webp", COLUMNS * (k - 1), codes(&values).into_iter().map(rgb).collect()));
        images.push(("shN_labels.webp", width, palette.labels.iter().map(label).collect()));
        meta["shN"] = json!({
            "count": palette.centers.len() / (3 * (k - 1)), "bands": scene.sh_degree, "codebook": padded(values.centers),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    let meta = std::iter::once(Ok((META, serde_json::to_vec(&meta)?)));
    meta.chain(images.into_iter().map(|(name, width, texels)| Ok((name, webp(width, texels)?)))).collect()
}

fn rgb([r, g, b]: [u8; 3]) -> [u8; 4] {
    [r, g, b, 255]
}

/// Readers expect all entries.
fn padded(mut codes: Vec<f32>) -> Vec<f32> {
    codes.resize(CODES, codes.last().copied().unwrap_or_default());
    codes
}

/// Three components other than the largest, in ±1/sqrt(2); alpha is 252 plus the largest's index.
fn pack(quat: [f32; 4]) -> [u8; 4] {
    let quat = unit_quaternion(quat).map(f64::from);
    let largest = (0..4).fold(0, |best, i| if quat[i].abs() > quat[best].abs() { i } else { best });
    let scale = quat[largest].signum() * std::f64::consts::SQRT_2;
    let mut others = (0..4).filter(|i| *i != largest).map(|i| (127.5 * (scale * quat[i] + 1.0)).round() as u8);
    let mut next = || others.next().unwrap_or_default();
    [next(), next(), next(), 252 + largest as u8]
}

fn unpack([a, b, c, tag]: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(tag.checked_sub(252)?);
    let small = [a, b, c].map(|x| (f64::from(x) / 127.5 - 1.0) * std::f64::consts::FRAC_1_SQRT_2);
    let rest = (1.0 - small.iter().map(|x| x * x).sum::<f64>()).max(0.0).sqrt();
    let mut quat = small.to_vec();
    quat.insert(largest, rest);
    Some(std::array::from_fn(|i| quat[i] as f32))
}

type Parsed<T> = std::result::Result<T, String>;

struct Archive<'a>(ZipArchive<Cursor<&'a [u8]>>);

impl<'a> Archive<'a> {
    fn open(bytes: &'a [u8]) -> Parsed<(Self, Meta)> {
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|error| format!("ZIP: {error}"))?;
        let mut archive = Self(archive);
        let meta = archive.file(META, MAX_META)?;
        let value: Value = serde_json::from_slice(&meta).map_err(|error| format!("{META}: {error}"))?;
        if value["version"] != VERSION {
            return Err(format!("{META}: found version {}, expected {VERSION}", value["version"]));
        }
        Ok((archive, serde_json::from_value(value).map_err(|error| format!("{META}: {error}"))?))
    }

    fn file(&mut self, name: &str, most: u64) -> Parsed<Vec<u8>> {
        let fault = |error: &dyn std::fmt::Display| format!("{name}: {error}");
        let file = self.0.by_name(name).map_err(|error| fault(&error))?;
        let mut bytes = Vec::new();
        file.take(most + 1).read_to_end(&mut bytes).map_err(|error| fault(&error))?;
        if bytes.len() as u64 > most {
            return Err(format!("{name}: found more than {most} bytes"));
        }
        Ok(bytes)
    }

    fn texels(&mut self, name: &str, least: usize) -> Parsed<Texels> {
        let bytes = self.file(name, MAX_IMAGE)?;
        let fault = |error: &dyn std::fmt::Display| format!("{name}: {error}");
        let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|error| fault(&error))?;
        let image = reader.decode().map_err(|error| fault(&error))?.into_rgba8();
        let (width, height) = (image.width() as usize, image.height() as usize);
        if width * height < least {
            return Err(format!("{name}: found {width}x{height} pixels, expected {least} or more"));
        }
        Ok(Texels { width, rgba: image.into_raw().as_chunks().0.to_vec() })
    }

    fn read_rest(&mut self, rest: &Rest, scene: &mut Scene) -> Parsed<()> {
        let (coeffs, [file, labels]) = (scene.sh_coeffs_per_gaussian() - 1, &rest.files);
        let indices = self.texels(labels, scene.len())?.rgba;
        let centroids = self.texels(file, rest.count.saturating_mul(coeffs))?;
        let expected = COLUMNS * coeffs;
        if centroids.width != expected {
            return Err(format!("{file}: found a width of {}, expected {expected}", centroids.width));
        }
        for (i, (coeffs_of, [a, b, ..])) in scene.sh_coeffs.chunks_exact_mut(coeffs + 1).zip(indices).enumerate() {
            let entry = usize::from(u16::from_le_bytes([a, b]));
            if entry >= rest.count {
                return Err(format!("{labels}, pixel {i}: found entry {entry} of {}", rest.count));
            }
            for (coeff, texel) in coeffs_of[1..].iter_mut().zip(&centroids.rgba[entry * coeffs..]) {
                *coeff = coded(&rest.codebook, *texel, "shN")?;
            }
        }
        Ok(())
    }
}

fn read_line(mut source: Source<'_>) -> Result<Option<String>> {
    let bytes = source.rest()?;
    Ok(Archive::open(&bytes).ok().and_then(|(_, meta)| Some(meta.asset["generator"].as_str()?.to_owned())))
}

fn read_unchecked(mut source: Source<'_>) -> Result<Scene> {
    let bytes = source.rest()?;
    decode(&bytes).map_err(|reason| Error::format(source.name, None, reason))
}

fn decode(bytes: &[u8]) -> Parsed<Scene> {
    let (mut archive, meta) = Archive::open(bytes)?;
    let n = meta.count;
    let [low, high] = [0, 1].map(|half| archive.texels(&meta.means.files[half], n));
    let (low, high) = (low?, high?);
    let [scales, quats, colors] =
        [&meta.scales.files[0], &meta.quats.files[0], &meta.sh0.files[0]].map(|file| archive.texels(file, n));
    let (scales, quats, colors) = (scales?.rgba, quats?.rgba, colors?.rgba);
    let rest = meta.sh_rest.as_ref().filter(|rest| rest.bands > 0);
    let degree = rest.map_or(0, |rest| rest.bands);
    if degree > Scene::MAX_SH_DEGREE {
        return Err(format!("{META}: found {degree} bands, expected 0 to {}", Scene::MAX_SH_DEGREE));
    }
    let antialiased = meta.antialias || meta.model.as_deref() == Some(ANTIALIASED);
    let mut scene = Scene { antialiased, ..Scene::zeroed(n, degree) };
    let k = scene.sh_coeffs_per_gaussian();
    for i in 0..n {
        scene.means[i] = std::array::from_fn(|axis| {
            let place = f64::from(u16::from_le_bytes([low.rgba[i][axis], high.rgba[i][axis]])) / 65535.0;
            let (least, most) = (meta.means.mins[axis], meta.means.maxs[axis]);
            unlog(least + (most - least) * place) as f32
        });
        scene.scales[i] = coded(&meta.scales.codebook, scales[i], "scales")?.map(f32::exp);
        scene.sh_coeffs[i * k] = coded(&meta.sh0.codebook, colors[i], "sh0")?;
        scene.opacities[i] = f32::from(colors[i][3]) / 255.0;
        let tag = || format!("{}, pixel {i}: found alpha {}, expected 252 to 255", meta.quats.files[0], quats[i][3]);
        scene.quats[i] = unpack(quats[i]).ok_or_else(tag)?;
    }
    rest.map_or(Ok(()), |rest| archive.read_rest(rest, &mut scene))?;
    Ok(scene)
}

fn coded(codebook: &[f32], [r, g, b, _]: [u8; 4], name: &str) -> Parsed<[f32; 3]> {
    let codes: &[f32; CODES] =
        codebook.try_into().map_err(|_| format!("{META}: {name} has {} codes, expected {CODES}", codebook.len()))?;
    Ok([r, g, b].map(|index| codes[usize::from(index)]))
}
