//! The report: one HTML file that needs no other.

use super::{
    Tradeoff, figures,
    point::{Point, front},
    sweep::Sweep,
};
use crate::{capture::Capture, table::bytes};
use base64::{Engine, engine::general_purpose::STANDARD};
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use zipsplat::{Error, Result, types::Image};

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#222}\
    figure{display:inline-block;margin:0 1em 1.5em 0;vertical-align:top}figcaption{font-weight:600;max-width:560px}\
    .picture img{width:180px;image-rendering:auto}table{border-collapse:collapse;font-size:13px}\
    td,th{padding:2px 8px;text-align:right;border-bottom:1px solid #ddd}td:first-child,code{text-align:left}\
    .small svg{width:360px}tr.front{background:#eef6ee}code{font-size:12px;white-space:nowrap}svg{max-width:100%;height:auto}";

const DEVIATIONS: &str = "The same network in f64 on the CPU, for reconstructions of at most 20 GFLOP. All precisions take the \
    tokens that the first one chose, so that these are errors of arithmetic and not other choices of near ties. Pictures are \
    drawn by the device from its own Gaussians and from those of f64.";

/// The whole page.
///
/// # Errors
/// Where a picture cannot be encoded.
pub fn page(args: &Tradeoff, device: &str, weights: &str, captures: &[Capture], sweep: &Sweep) -> Result<String> {
    let mut html = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=generator content=zipsplat><title>What accuracy costs in time</title>\
         <style>{STYLE}</style><h1>What accuracy costs in time</h1>\
         <p>{} on {}, weights: {}. {} combinations, each the median of {} runs.</p>",
        escape(&args.folder.display().to_string()),
        escape(device),
        escape(weights),
        sweep.points.len(),
        args.repeats
    );
    let plots = |figures: Vec<(&str, String)>| -> String {
        let figure = |(heading, svg)| format!("<figure><figcaption>{heading}</figcaption>{svg}</figure>");
        figures.into_iter().map(figure).collect()
    };
    html += &plots(figures::figures(sweep));
    let deviations = figures::deviations(&sweep.points);
    if !deviations.is_empty() {
        html +=
            &format!("<h2>How far from f64</h2><p>{DEVIATIONS}</p><div class=\"small\">{}</div>", plots(deviations));
    }
    html += "<h2>The same photo, drawn</h2>";
    if let Some(capture) = captures.iter().max_by_key(|capture| capture.inputs.len()) {
        let target = &capture.targets[0];
        html += &picture("the photo", &target.image)?;
        html += &picture("the nearest photo given", &capture.nearest(target).image)?;
    }
    for (label, image) in &sweep.pictures {
        html += &picture(label, image)?;
    }
    html += "<h2>Every point</h2><p>Those on the front are green: no other is both faster and better.</p>";
    html += &table(&sweep.points);
    Ok(html + "</html>\n")
}

fn table(points: &[Point]) -> String {
    let mut html = String::from(
        "<table><tr><th>photos</th><th>precision</th><th>r</th><th>tokens chosen by</th><th>kept of a token</th>\
         <th>Gaussians</th><th>ms</th><th>ms a picture</th><th>peak</th><th>file</th><th>PSNR</th><th>SSIM</th>\
         <th>PSNR to exact</th><th>to f64</th><th>shown by</th></tr>",
    );
    let front = front(points);
    for (i, p) in points.iter().enumerate() {
        html += &format!(
            "<tr{}><td>{}</td><td>{}</td><td>{:.3}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.1}</td><td>{:.2}</td>\
             <td>{}</td><td>{}</td><td>{:.2}</td><td>{:.3}</td><td>{}</td><td>{}</td><td><code>{}</code></td></tr>",
            if front.contains(&i) { " class=\"front\"" } else { "" },
            p.views,
            p.precision,
            p.ratio,
            p.select,
            p.keep,
            p.gaussians,
            p.forward_ms,
            p.render_ms,
            bytes(p.peak_bytes),
            bytes(p.file_bytes),
            p.psnr,
            p.ssim,
            decibels(p.psnr_to_exact),
            decibels(p.psnr_to_f64),
            escape(&p.command)
        );
    }
    html + "</table>"
}

fn decibels(psnr: Option<f64>) -> String {
    psnr.map_or_else(String::new, |psnr| format!("{psnr:.1}"))
}

fn picture(label: &str, image: &Image) -> Result<String> {
    let mut png = Vec::new();
    PngEncoder::new(&mut png)
        .write_image(&image.rgb, image.width, image.height, ExtendedColorType::Rgb8)
        .map_err(|error| Error::io("a picture of the report", std::io::Error::other(error)))?;
    let data = STANDARD.encode(png);
    Ok(format!(
        "<figure class=\"picture\"><img alt=\"{0}\" src=\"data:image/png;base64,{data}\"><figcaption>{0}</figcaption></figure>",
        escape(label)
    ))
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::{super::point::tests::point, *};

    #[test]
    fn the_front_is_marked_and_text_escaped() {
        let html = table(&[point(2.0, 10.0), point(1.0, 20.0)]);
        assert_eq!(html.matches("<tr class=\"front\">").count(), 1, "{html}");
        assert!(html.contains("&quot;a b&quot; &lt;&amp;&gt;"), "{html}");
    }
}
