use super::{
    Tradeoff,
    figures::{self, Figure},
    point::{Point, front, recommended},
    sweep::Sweep,
};
use crate::{
    capture::ViewSplit,
    html::{self, escape},
    table::{bytes, counted, time},
};
use std::time::Duration;
use zipsplat::Result;

const SCRIPT: &str = include_str!("page.js");
/// Longer side in pixels.
const PICTURE: u32 = 252;

const DEVIATIONS: &str = "The same network in f64 on the CPU, for reconstructions of at most 20 GFLOP from the most photos. All \
    precisions take the tokens that the first one chose, so that these are errors of arithmetic and not other choices of near ties. \
    Pictures are drawn by the device from its own Gaussians and from those of f64.";

pub fn page(
    args: &Tradeoff,
    device: &str,
    weights: &str,
    captures: &[ViewSplit],
    sweep: &Sweep,
    pareto: &str,
    figures: &[Figure],
) -> Result<String> {
    let points = &sweep.points;
    let pictures: Vec<String> =
        sweep.pictures.iter().map(|picture| html::picture(picture, PICTURE)).collect::<Result<_>>()?;
    let mut html = html::begin("What accuracy costs in time");
    html += &format!(
        "<p>{} on {}, weights: {}. {} points; times of reconstructions are medians of {}, a refinement runs once.</p>",
        escape(&args.folder.display().to_string()),
        escape(device),
        escape(weights),
        points.len(),
        counted(args.repeats as usize, "run")
    );
    let chosen = recommended(points);
    html += "<h2>Settings to begin with</h2><div class=\"cards\">";
    if let Some(capture) = captures.iter().max_by_key(|capture| capture.inputs.len()) {
        let target = &capture.targets[0];
        html += &card("the photo", &html::picture(&target.image, PICTURE)?, "<p>held out: no setting has seen it</p>");
        html += &card("the nearest photo given", &html::picture(&capture.nearest(target).image, PICTURE)?, "");
    }
    for (name, i) in &chosen {
        html += &card(name, &pictures[*i], &about(&points[*i]));
    }
    html += "</div><p class=\"note\"><b>best</b> is the most accurate point. <b>fast</b> is the fastest that has half of what the front has \
             to win in dB. <b>balanced</b> lies between them, farthest above the line that joins them.</p>";
    html += &figure("Every point, and the front that no other beats in both", pareto);
    html += "<p class=\"note\">Point at a place in a plot or a row of a table, or touch it: its picture and its command are shown.</p>";
    html += "<h2>The front</h2>";
    html += &table(points, front(points).into_iter(), &[]);
    html += "<h2>One setting at a time</h2><div class=\"figures\">";
    html += &figures.iter().map(|one| figure(one.heading, &one.plot)).collect::<String>();
    html += "</div>";
    let deviations = figures::deviations(points);
    if !deviations.is_empty() {
        let plots: String = deviations.iter().map(|(heading, plot)| figure(heading, plot)).collect();
        html += &format!("<h2>How far from f64</h2><p>{DEVIATIONS}</p><div class=\"figures\">{plots}</div>");
    }
    html += "<h2>Every point</h2><p>Those on the front are green.</p>";
    html += &table(points, 0..points.len(), &front(points));
    html += &points.iter().zip(&pictures).enumerate().map(|(i, (p, picture))| panel(i, p, picture)).collect::<String>();
    Ok(format!("{html}<script>{SCRIPT}</script></html>\n"))
}

fn figure(heading: &str, plot: &str) -> String {
    format!("<figure><figcaption>{heading}</figcaption>{plot}</figure>")
}

fn card(name: &str, picture: &str, about: &str) -> String {
    format!("<div class=\"card\"><img alt=\"{name}\" src=\"{picture}\"><b>{name}</b>{about}</div>")
}

fn panel(i: usize, p: &Point, picture: &str) -> String {
    format!("<div class=\"panel\" id=\"p{i}\" hidden><img alt=\"\" src=\"{picture}\"><div>{}</div></div>", about(p))
}

fn about(p: &Point) -> String {
    format!(
        "<p>{:.2} dB in {}</p><p>{}</p><code>{}</code>",
        p.psnr,
        took(p.total_ms),
        escape(&p.settings()),
        escape(&p.command)
    )
}

fn took(ms: f64) -> String {
    time(Duration::from_secs_f64(ms / 1e3))
}

fn table(points: &[Point], rows: impl Iterator<Item = usize>, marked: &[usize]) -> String {
    let mut html = String::from(
        "<table><tr><th>photos<th>precision<th class=\"wide\">weights<th>r<th class=\"wide\">tokens by<th class=\"wide\">kept of a token<th>steps\
         <th class=\"wide\">Gaussians<th>time<th class=\"wide\">ms a picture<th class=\"wide\">peak<th class=\"wide\">file\
         <th>dB<th class=\"wide\">SSIM<th class=\"wide\">dB to fp32<th class=\"wide\">to f64</tr>",
    );
    for i in rows {
        let p = &points[i];
        html += &format!(
            "<tr data-point=\"{i}\"{}><td>{}<td>{}<td class=\"wide\">{}<td>{:.2}<td class=\"wide\">{}<td class=\"wide\">{}<td>{}<td class=\"wide\">{}\
             <td>{}<td class=\"wide\">{:.2}<td class=\"wide\">{}<td class=\"wide\">{}<td>{:.2}<td class=\"wide\">{:.3}\
             <td class=\"wide\">{}<td class=\"wide\">{}</tr>",
            if marked.contains(&i) { " class=\"front\"" } else { "" },
            p.views,
            p.arithmetic(),
            bytes(p.weight_bytes),
            p.ratio,
            p.token_selection,
            p.max_gaussians_per_token,
            p.refinement(),
            p.gaussians,
            took(p.total_ms),
            p.render_ms,
            bytes(p.peak_bytes),
            bytes(p.file_bytes),
            p.psnr,
            p.ssim,
            decibels(p.psnr_to_fp32),
            decibels(p.psnr_to_f64),
        );
    }
    html + "</table>"
}

fn decibels(psnr: Option<f64>) -> String {
    psnr.map_or_else(String::new, |psnr| format!("{psnr:.1}"))
}

#[cfg(test)]
mod tests {
    use super::{super::point::tests::point, *};

    #[test]
    fn the_front_is_marked_and_text_escaped() {
        let points = [point(2.0, 10.0), point(1.0, 20.0)];
        let html = table(&points, 0..2, &front(&points));
        assert!(
            html.contains("<tr data-point=\"1\" class=\"front\">") && html.contains("<tr data-point=\"0\">"),
            "{html}"
        );
        let html = panel(3, &points[0], "data:");
        assert!(html.contains("id=\"p3\" hidden") && html.contains("&quot;a b&quot; &lt;&amp;&gt;"), "{html}");
    }
}
