//! The Pareto front, and the paper's figures 1, 8, 10, 11 and 12. Each varies one setting by color,
//! at the first precision, otherwise with all Gaussians and without refinement.

use super::{
    point::{Point, front},
    sweep::Sweep,
};
use crate::plot::{At, Axis, Scale, Series, plot};
use zipsplat::reconstruct::TokenSelection;

const fn linear(label: &str) -> Axis<'_> {
    Axis { label, scale: Scale::Linear }
}

const fn log(label: &str) -> Axis<'_> {
    Axis { label, scale: Scale::Log }
}

const PSNR: Axis<'_> = linear("PSNR of held-out photos, dB");
const TIME: Axis<'_> = log("photos to Gaussians, ms");
const GAUSSIANS: Axis<'_> = log("Gaussians");
const VIEWS: Axis<'_> = linear("input photos");
const SHARE: Axis<'_> = log("share of tokens");

type Meaning = (&'static str, fn(&Point) -> String);

const PHOTOS: Meaning = ("input photos", |p| p.views.to_string());
const CHOSEN: Meaning = ("tokens chosen by", |p| p.token_selection.clone());
const RATIO: Meaning = ("share of tokens", |p| p.asked_ratio.clone());
const PRECISION: Meaning = ("precision", Point::arithmetic);
const KEPT: Meaning = ("Gaussians a token", |p| p.max_gaussians_per_token.to_string());
const POOL: Meaning = ("--kv-pool", |p| p.kv_pool.clone());
const ORIGIN: Meaning = ("Gaussians of", Point::origin);

type Numbered<'a> = (usize, &'a Point);

pub fn pareto(points: &[Point]) -> String {
    let all: Vec<Numbered<'_>> = points.iter().enumerate().collect();
    let place = |p: &Point| (p.total_ms, p.psnr);
    let meaning = if points.iter().any(Point::is_refined) { ORIGIN } else { PRECISION };
    let mut series = series(&all, meaning, place);
    series.iter_mut().for_each(|series| series.line = false);
    let at = |i: usize| At { x: points[i].total_ms, y: points[i].psnr, of: None };
    let line = Series { name: "front".into(), points: front(points).into_iter().map(at).collect(), line: true };
    plot(log("photos to refined Gaussians, ms"), PSNR, meaning.0, &series, Some(&line))
}

pub struct Figure {
    pub heading: &'static str,
    pub plot: String,
    /// A figure without times: equal in repeated sweeps of a device.
    pub is_repeatable: bool,
}

pub fn figures(sweep: &Sweep) -> Vec<Figure> {
    let all: Vec<Numbered<'_>> = sweep.points.iter().enumerate().collect();
    let first_pool = sweep.points.first().map_or("1", |p| &p.kv_pool);
    let plain = those(&all, |p| !p.is_refined() && p.kv_pool == first_pool);
    let most = plain.iter().map(|(_, p)| p.views).max().unwrap_or(0);
    let keep = plain.iter().map(|(_, p)| p.max_gaussians_per_token).max().unwrap_or(0);
    let first = plain.first().map_or_else(String::new, |(_, p)| p.arithmetic());
    let own = TokenSelection::KMEANS.to_string();
    let kmeans = |p: &Point| p.token_selection == "all" || p.token_selection == own;
    let full = those(&plain, |p| p.max_gaussians_per_token == keep && p.arithmetic() == first);
    let (best, ours) = (those(&full, |p| p.views == most), those(&full, kmeans));
    let kept = those(&plain, |p| p.views == most && p.arithmetic() == first && kmeans(p));
    let whole = those(&plain, |p| p.max_gaussians_per_token == keep && p.token_selection == "all");
    let refined = those(&all, |p| p.views == most && p.arithmetic() == first && p.max_gaussians_per_token == keep);
    let refined = those(&refined, |p| (kmeans(p) || p.is_of_points()) && !p.refine.contains(':'));
    let repeatable = |heading, plot| Figure { heading, plot, is_repeatable: true };
    let other = |heading, plot| Figure { heading, plot, is_repeatable: false };
    let (by_gaussians, by_ratio) = (|p: &Point| (p.gaussians as f64, p.psnr), |p: &Point| (p.ratio, p.psnr));
    let spanned = |p: &Point| (p.ratio, p.views_per_cluster.unwrap_or(f64::NAN));
    let by_views = |value: fn(&Point) -> f64| move |p: &Point| (p.views as f64, value(p));
    let mut figures = vec![
        repeatable(
            "Quality against the number of Gaussians (figure 1)",
            by(&best, GAUSSIANS, PSNR, CHOSEN, by_gaussians),
        ),
        repeatable("Quality against the budget (figure 8)", by(&ours, GAUSSIANS, PSNR, PHOTOS, by_gaussians)),
        repeatable("How tokens are chosen (figure 10, left)", by(&best, SHARE, PSNR, CHOSEN, by_ratio)),
        repeatable(
            "Photos that a cluster spans (figure 10, right)",
            by(&ours, SHARE, linear("photos a cluster"), PHOTOS, spanned),
        ),
        other("Time of each stage, every token (figure 11, a)", stages(sweep)),
        other("Time against photos (figure 11, a)", by(&ours, VIEWS, TIME, RATIO, by_views(|p| p.forward_ms))),
        other("Time of each precision, every token", by(&whole, VIEWS, TIME, PRECISION, by_views(|p| p.forward_ms))),
        repeatable(
            "Peak of memory (figure 11, b)",
            by(&ours, VIEWS, log("MiB"), RATIO, by_views(|p| mib(p.peak_bytes))),
        ),
        other(
            "Pictures a second (figure 12, a)",
            by(&ours, VIEWS, log("pictures a second"), RATIO, by_views(|p| 1e3 / p.render_ms)),
        ),
        repeatable(
            "Size of the scene's file (figure 12, b)",
            by(&ours, VIEWS, log("MiB"), RATIO, by_views(|p| mib(p.file_bytes))),
        ),
        other("Gaussians kept of each token", by(&kept, GAUSSIANS, PSNR, KEPT, by_gaussians)),
    ];
    if sweep.points.iter().any(|p| p.kv_pool != first_pool) {
        let pooled = those(&all, |p| {
            !p.is_refined() && p.max_gaussians_per_token == keep && p.arithmetic() == first && kmeans(p)
        });
        let pooled = those(&pooled, |p| Some(&p.asked_ratio) == sweep.points.first().map(|p| &p.asked_ratio));
        let plot = by(&pooled, TIME, PSNR, POOL, |p| (p.forward_ms, p.psnr));
        figures.push(other("Patches that attention sees as one", plot));
    }
    if sweep.points.iter().any(Point::is_refined) {
        let plot = by(&refined, log("photos to refined Gaussians, ms"), PSNR, RATIO, |p| (p.total_ms, p.psnr));
        figures.insert(0, other("Steps of refinement, from left to right (section 4.2)", plot));
    }
    figures
}

fn those<'a>(points: &[Numbered<'a>], keeps: impl Fn(&Point) -> bool) -> Vec<Numbered<'a>> {
    points.iter().copied().filter(|(_, p)| keeps(p)).collect()
}

pub fn deviations(points: &[Point]) -> Vec<(&'static str, String)> {
    let keep = points.iter().map(|p| p.max_gaussians_per_token).max().unwrap_or(0);
    let own = TokenSelection::KMEANS.to_string();
    let compared = |p: &Point| {
        p.max_gaussians_per_token == keep
            && (p.token_selection == "all" || p.token_selection == own)
            && p.psnr_to_f64.is_some()
    };
    let most = points.iter().filter(|p| compared(p)).map(|p| p.views).max();
    let all: Vec<Numbered<'_>> = points.iter().enumerate().collect();
    let compared = those(&all, |p| compared(p) && Some(p.views) == most);
    if compared.is_empty() {
        return Vec::new();
    }
    let plot = |y: Axis<'_>, of: fn(&Point) -> Option<f64>| {
        by(&compared, SHARE, y, PRECISION, |p| (p.ratio, of(p).unwrap_or(f64::NAN)))
    };
    let error = |of: fn(&Point) -> Option<f64>| plot(log("rms of difference / of truth"), of);
    vec![
        ("Backbone: tokens of all output layers", error(|p| p.error_backbone)),
        ("Fusion: scene tokens", error(|p| p.error_fuse)),
        ("Gaussians: means", error(|p| p.error_means)),
        ("Gaussians: scales", error(|p| p.error_scales)),
        ("Gaussians: rotations", error(|p| p.error_quats)),
        ("Gaussians: opacities", error(|p| p.error_opacities)),
        ("Gaussians: colors", error(|p| p.error_sh_coeffs)),
        ("Pictures", plot(linear("PSNR to those of f64, dB"), |p| p.psnr_to_f64)),
    ]
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

fn by(
    points: &[Numbered<'_>],
    x: Axis<'_>,
    y: Axis<'_>,
    meaning: Meaning,
    place: impl Fn(&Point) -> (f64, f64),
) -> String {
    let mut series = series(points, meaning, place);
    // All selections have it.
    if let Some(all) = series.iter().position(|series| series.name == "all").filter(|_| series.len() > 1) {
        let all = series.remove(all);
        series.iter_mut().for_each(|series| series.points.extend(&all.points));
    }
    series.iter_mut().for_each(|series| series.points.sort_by(|a, b| a.x.total_cmp(&b.x)));
    plot(x, y, meaning.0, &series, None)
}

fn series(points: &[Numbered<'_>], (_, value): Meaning, place: impl Fn(&Point) -> (f64, f64)) -> Vec<Series> {
    let mut series: Vec<Series> = Vec::new();
    for (i, p) in points {
        let ((x, y), name) = (place(p), value(p));
        let at = At { x, y, of: Some(*i) };
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(at),
            None => series.push(Series { name, points: vec![at], line: true }),
        }
    }
    series
}

fn stages(sweep: &Sweep) -> String {
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in sweep.stages.iter().flat_map(|(_, times)| &times.0) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let time = |name: &str, (views, times): &(usize, zipsplat::gpu::StageTimes)| {
        let took = times.0.iter().find(|(stage, _)| stage == name).map(|(_, took)| 1e3 * took.as_secs_f64());
        At { x: *views as f64, y: took.unwrap_or(f64::NAN), of: None }
    };
    let of_stage = |name: &str| Series {
        name: name.into(),
        points: sweep.stages.iter().map(|stage| time(name, stage)).collect(),
        line: true,
    };
    let series: Vec<Series> = names.into_iter().filter(|name| !name.is_empty()).map(of_stage).collect();
    plot(VIEWS, log("ms"), "stage", &series, None)
}
