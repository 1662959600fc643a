//! The plots: those of the paper's figures 1, 8, 10, 11 and 12, with our numbers, and the front of time and PSNR.

use super::{
    point::{Point, front, name},
    sweep::Sweep,
};
use crate::plot::{Axis, Scale, Series, plot};
use std::collections::BTreeSet;
use zipsplat::reconstruct::Selection;

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

/// Heading and SVG of each plot.
pub fn figures(sweep: &Sweep) -> Vec<(&'static str, String)> {
    let points = &sweep.points;
    let most = points.iter().map(|p| p.views).max().unwrap_or(0);
    let all = points.iter().map(|p| p.keep).max().unwrap_or(0);
    let full: Vec<&Point> = points.iter().filter(|p| p.keep == all).collect();
    let own = name(&Selection::KMEANS);
    let kmeans = |p: &&Point| p.select == "all" || p.select == own;
    vec![
        ("What accuracy costs in time", pareto(points)),
        (
            "Quality against the number of Gaussians (figure 1)",
            by(&full, GAUSSIANS, PSNR, |p| p.views == most, |p| p.select.clone(), |p| (p.gaussians as f64, p.psnr)),
        ),
        (
            "Quality against the budget, for each number of photos (figure 8)",
            by(
                &full,
                GAUSSIANS,
                PSNR,
                |p| kmeans(&p),
                |p| format!("{} photos", p.views),
                |p| (p.gaussians as f64, p.psnr),
            ),
        ),
        (
            "How tokens are chosen (figure 10, left)",
            by(&full, log("share of tokens"), PSNR, |p| p.views == most, |p| p.select.clone(), |p| (p.ratio, p.psnr)),
        ),
        (
            "Photos that a cluster spans (figure 10, right)",
            by(
                &full,
                log("share of tokens"),
                linear("photos a cluster"),
                |p| kmeans(&p),
                photos,
                |p| (p.ratio, p.views_per_cluster.unwrap_or(f64::NAN)),
            ),
        ),
        ("Time of each stage, every token (figure 11, a)", stages(sweep)),
        (
            "Time against photos (figure 11, a)",
            by(&full, VIEWS, TIME, |p| kmeans(&p), share, |p| (p.views as f64, p.forward_ms)),
        ),
        (
            "Peak of memory (figure 11, b)",
            by(&full, VIEWS, log("MiB"), |p| kmeans(&p), share, |p| (p.views as f64, mib(p.peak_bytes))),
        ),
        (
            "Pictures a second (figure 12, a)",
            by(&full, VIEWS, log("pictures a second"), |p| kmeans(&p), share, |p| (p.views as f64, 1e3 / p.render_ms)),
        ),
        (
            "Size of the scene's file (figure 12, b)",
            by(&full, VIEWS, log("MiB"), |p| kmeans(&p), share, |p| (p.views as f64, mib(p.file_bytes))),
        ),
        (
            "Gaussians kept of each token",
            by(
                &points.iter().collect::<Vec<_>>(),
                GAUSSIANS,
                PSNR,
                |p| p.views == most && kmeans(&p),
                |p| format!("{} a token", p.keep),
                |p| (p.gaussians as f64, p.psnr),
            ),
        ),
    ]
}

/// The same for deviations from f64; none where nothing was compared with it.
pub fn deviations(points: &[Point]) -> Vec<(&'static str, String)> {
    let all = points.iter().map(|p| p.keep).max().unwrap_or(0);
    let own = name(&Selection::KMEANS);
    let compared = |p: &&Point| p.keep == all && (p.select == "all" || p.select == own) && p.psnr_to_f64.is_some();
    let compared: Vec<&Point> = points.iter().filter(compared).collect();
    if compared.is_empty() {
        return Vec::new();
    }
    let plot = |y: Axis<'_>, of: fn(&Point) -> Option<f64>| {
        by(&compared, log("share of tokens"), y, |_| true, photos, |p| (p.ratio, of(p).unwrap_or(f64::NAN)))
    };
    let error = |of: fn(&Point) -> Option<f64>| plot(log("rms of the difference / rms of the truth"), of);
    vec![
        ("Backbone: tokens of all output layers", error(|p| p.error_backbone)),
        ("Fusion: scene tokens", error(|p| p.error_fuse)),
        ("Gaussians: means", error(|p| p.error_means)),
        ("Gaussians: scales", error(|p| p.error_scales)),
        ("Gaussians: rotations", error(|p| p.error_quats)),
        ("Gaussians: opacities", error(|p| p.error_opacities)),
        ("Gaussians: colours", error(|p| p.error_sh_coeffs)),
        ("Pictures", plot(linear("PSNR to those of f64, dB"), |p| p.psnr_to_f64)),
    ]
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

fn photos(p: &Point) -> String {
    format!("{} photos", p.views)
}

fn share(p: &Point) -> String {
    format!("r = {:.2}", p.ratio)
}

/// A line a group of the points that are `of` it, joined from left to right; each precision has its own.
fn by(
    points: &[&Point],
    x: Axis<'_>,
    y: Axis<'_>,
    of: impl Fn(&Point) -> bool,
    group: impl Fn(&Point) -> String,
    place: impl Fn(&Point) -> (f64, f64),
) -> String {
    let chosen: Vec<&&Point> = points.iter().filter(|p| of(p)).collect();
    let precisions: BTreeSet<&str> = chosen.iter().map(|p| p.precision.as_str()).collect();
    let name = |p: &Point| {
        let group = group(p);
        if precisions.len() > 1 { format!("{group}, {}", p.precision) } else { group }
    };
    let mut series: Vec<Series> = Vec::new();
    for p in &chosen {
        let name = name(p);
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(place(p)),
            None => series.push(Series { name, points: vec![place(p)], line: true }),
        }
    }
    // Every way to choose ends at choosing all.
    if let Some(all) = series.iter().position(|series| series.name.starts_with("all")).filter(|_| series.len() > 1) {
        let all = series.remove(all);
        series.iter_mut().for_each(|series| series.points.extend(&all.points));
    }
    series.iter_mut().for_each(|series| series.points.sort_by(|a, b| a.0.total_cmp(&b.0)));
    plot(x, y, &series)
}

fn pareto(points: &[Point]) -> String {
    let place = |p: &Point| (p.forward_ms, p.psnr);
    let precisions: BTreeSet<&str> = points.iter().map(|p| p.precision.as_str()).collect();
    let mut series = vec![Series {
        name: "front".into(),
        points: front(points).into_iter().map(|i| place(&points[i])).collect(),
        line: true,
    }];
    series.extend(precisions.into_iter().map(|precision| Series {
        name: precision.into(),
        points: points.iter().filter(|p| p.precision == precision).map(place).collect(),
        line: false,
    }));
    plot(TIME, PSNR, &series)
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
        (*views as f64, took.unwrap_or(f64::NAN))
    };
    let series: Vec<Series> = (names.into_iter())
        .map(|name| Series {
            name: name.into(),
            points: sweep.stages.iter().map(|stage| time(name, stage)).collect(),
            line: true,
        })
        .collect();
    plot(VIEWS, log("ms"), &series)
}
