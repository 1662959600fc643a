use crate::{
    html::{self, escape},
    plot::{At, Axis, Scale, Series, plot},
};
use zipsplat::gpu::Limits;
use zipsplat_verify::{Area, Finding, Worst};

/// Least error shown, relative to the largest.
const LEAST: f64 = 1e-24;

pub fn page(limits: &Limits, areas: &[Area], findings: &[Finding]) -> String {
    let outside = findings.iter().filter(|finding| !finding.holds).count();
    let verdict = match outside {
        0 => format!("All {} results are within their bounds.", findings.len()),
        n => format!("<span class=outside>{n} of {} results are outside their bounds.</span>", findings.len()),
    };
    let mut out = html::begin(&format!("zipsplat doctor: {}", limits.name));
    out += &format!(
        "<p>{}, Vulkan {}, zipsplat {}. {verdict} Each case has its worst error and its bound; the line at the bottom is the \
         truth in f64.</p>",
        escape(&limits.driver),
        escape(&limits.api),
        env!("CARGO_PKG_VERSION"),
    );
    for area in areas {
        for mode in area.supported_modes(limits) {
            let found: Vec<&Finding> = findings.iter().filter(|f| f.kernel == area.kernel && f.mode == mode).collect();
            out += &format!(
                "<h2>{}, {}</h2><p>{}.</p>{}{}",
                escape(area.kernel),
                mode.name(),
                escape(area.reason),
                errors(area, &found),
                table(&found)
            );
        }
    }
    out + "</html>\n"
}

fn errors(area: &Area, findings: &[&Finding]) -> String {
    let computed: Vec<&Finding> = findings.iter().filter(|f| f.failed.is_none()).copied().collect();
    let values = computed.iter().flat_map(|f| [f.worst.error, f.worst.bound]);
    let values: Vec<f64> = values.filter(|value| value.is_finite() && *value > 0.0).collect();
    let largest = values.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    let least = values.iter().copied().fold(largest, f64::min).max(LEAST * largest);
    // Exact results have a separate decade below the least error.
    let truth = least / 10.0;
    let series = |name: &str, wanted: &dyn Fn(&Finding) -> bool, value: fn(&Worst) -> f64| {
        let found = computed.iter().filter(|f| wanted(f));
        let at = found.map(|f| At { x: f.size.max(1) as f64, y: value(&f.worst).clamp(truth, largest), of: None });
        Series { name: name.to_owned(), points: at.collect(), line: false }
    };
    let mut shown = vec![series("bound", &|_| true, |worst| worst.bound), series("error", &|f| f.holds, |w| w.error)];
    shown.extend((!computed.iter().all(|f| f.holds)).then(|| series("outside", &|f| !f.holds, |w| w.error)));
    let mut bottom = series("truth", &|_| true, |_| 0.0);
    bottom.points.sort_by(|a, b| a.x.total_cmp(&b.x));
    let axis = |label| Axis { label, scale: Scale::Log };
    plot(axis(area.size), axis("error"), "of each case", &shown, Some(&bottom))
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
