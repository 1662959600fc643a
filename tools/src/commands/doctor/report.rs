//! HTML report: errors, bounds and justifications by kernel.

use std::{collections::BTreeMap, fmt::Write};
use zipsplat::gpu::Limits;
use zipsplat_verify::{Area, Finding, Mode, Worst};

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 70.0;
const BELOW: f64 = 40.0;
/// Limit of decades shown, from the largest down.
const DECADES: f64 = 24.0;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:60rem;padding:0 1rem;color:#222}\
h2{margin-top:2.5rem}svg{width:100%;height:auto;font-size:11px}table{border-collapse:collapse;width:100%;font-size:13px}\
td,th{padding:.15rem .6rem;text-align:right;border-bottom:1px solid #eee}td:first-child,th:first-child,td:last-child,th:last-child{text-align:left}\
.outside{color:#c00;font-weight:bold}.grid{stroke:#e5e5e5}.truth{stroke:#222}.bound{stroke:#c60;fill:none}\
.limit{fill:#c60}.exact{fill:#06a}.fast{fill:#083}.matrix{fill:#80a}text{fill:#555}";

/// Returns the self-contained page.
pub fn page(limits: &Limits, areas: &[Area], findings: &[Finding]) -> String {
    let outside = findings.iter().filter(|finding| !finding.holds).count();
    let verdict = match outside {
        0 => format!("All {} results are within their bounds.", findings.len()),
        n => format!("<span class=outside>{n} of {} results are outside their bounds.</span>", findings.len()),
    };
    let mut out = format!(
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=generator content=zipsplat><title>zipsplat doctor: {name}</title><style>{STYLE}</style>\
         <h1>{name}</h1><p>{driver}, Vulkan {api}, zipsplat {version}. {verdict} Dots are the worst error of a case, ticks its \
         bound, the line at the bottom is the truth in f64.</p>",
        name = escape(&limits.name),
        driver = escape(&limits.driver),
        api = escape(&limits.api),
        version = env!("CARGO_PKG_VERSION"),
    );
    for area in areas {
        for &mode in area.modes.iter().filter(|mode| mode.is_on(limits)) {
            let found: Vec<&Finding> = findings.iter().filter(|f| f.kernel == area.kernel && f.mode == mode).collect();
            // Writing to a string cannot fail.
            let _ = write!(
                out,
                "<h2>{}, {}</h2><p>{}.</p>{}{}",
                escape(area.kernel),
                mode.name(),
                escape(area.reason),
                plot(area, mode, &found),
                table(&found)
            );
        }
    }
    out + "</html>\n"
}

fn plot(area: &Area, mode: Mode, findings: &[&Finding]) -> String {
    let shown = |x: f64| x.is_finite() && x > 0.0;
    let values = || findings.iter().flat_map(|f| [f.worst.error, f.worst.bound]).filter(|&x| shown(x)).map(f64::log10);
    let high = values().fold(f64::NEG_INFINITY, f64::max).ceil();
    let high = if high.is_finite() { high } else { 0.0 };
    let low = values().fold(high - 1.0, f64::min).floor().max(high - DECADES);
    let largest = findings.iter().map(|f| f.size.max(1)).max().unwrap_or(1) as f64;
    let right = largest.log10().ceil().max(1.0);
    let x = |size: usize| LEFT + (WIDTH - LEFT - 10.0) * (size.max(1) as f64).log10() / right;
    // Exact results have a separate decade below the least error.
    let y = |error: f64| {
        let place = if shown(error) { (error.log10().max(low) - low + 1.0) / (high - low + 1.0) } else { 0.0 };
        (HEIGHT - BELOW) - (HEIGHT - BELOW - 10.0) * if error.is_finite() { place } else { 1.0 }
    };
    let mut out = format!("<svg viewBox='0 0 {WIDTH} {HEIGHT}' role=img>");
    let step = ((high - low) / 8.0).ceil().max(1.0) as usize;
    for decade in (low as i32..=high as i32).step_by(step) {
        let at = y(10f64.powi(decade));
        let _ = write!(
            out,
            "<line class=grid x1={LEFT} x2={WIDTH} y1={at:.1} y2={at:.1} /><text x=5 y={:.1}>1e{decade}</text>",
            at + 4.0
        );
    }
    for decade in 0..=right as u32 {
        let at = x(10usize.pow(decade));
        let _ = write!(out, "<text x={at:.1} y={:.1} text-anchor=middle>1e{decade}</text>", HEIGHT - 22.0);
    }
    let base = HEIGHT - BELOW;
    let _ = write!(
        out,
        "<line class=truth x1={LEFT} x2={WIDTH} y1={base} y2={base} /><text x=5 y={:.1}>truth</text>\
         <text x={:.1} y={:.1} text-anchor=middle>{}</text>",
        base + 4.0,
        (LEFT + WIDTH) / 2.0,
        HEIGHT - 6.0,
        escape(area.size)
    );
    let mut lines: BTreeMap<&str, Vec<(usize, f64)>> = BTreeMap::new();
    for f in findings.iter().filter(|f| f.failed.is_none()) {
        let Worst { error, bound, .. } = f.worst;
        lines.entry(&f.case).or_default().push((f.size, bound));
        let title = escape(&format!("{}: error {error:.2e}, bound {bound:.2e}", f.case));
        let _ = write!(
            out,
            "<rect class=limit x={:.1} y={:.1} width=8 height=1.5 /><circle class={} cx={:.1} cy={:.1} r=3>\
             <title>{title}</title></circle>",
            x(f.size) - 4.0,
            y(bound),
            if f.holds { mode.name() } else { "outside" },
            x(f.size),
            y(error)
        );
    }
    for points in lines.values_mut().filter(|points| points.len() > 1) {
        points.sort_by_key(|point| point.0);
        let places: Vec<String> =
            points.iter().map(|&(size, bound)| format!("{:.1},{:.1}", x(size), y(bound))).collect();
        let _ = write!(out, "<polyline class=bound points='{}' />", places.join(" "));
    }
    out + "</svg>"
}

fn table(findings: &[&Finding]) -> String {
    let row = |f: &&Finding| {
        let class = if f.holds { "" } else { " class=outside" };
        let Worst { error, bound, share, .. } = f.worst;
        let (name, percent) = (escape(&f.case), 100.0 * share);
        if let Some(failed) = &f.failed {
            return format!("<tr{class}><td>{name}<td>{}<td colspan=4>{}", f.size, escape(failed));
        }
        let catches = escape(&f.catches.join(", "));
        format!("<tr{class}><td>{name}<td>{}<td>{error:.2e}<td>{bound:.2e}<td>{percent:.2} %<td>{catches}", f.size)
    };
    let rows: String = findings.iter().map(row).collect();
    format!("<table><tr><th>case<th>size<th>worst error<th>bound<th>share<th>catches{rows}</table>")
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('\'', "&#39;")
}
