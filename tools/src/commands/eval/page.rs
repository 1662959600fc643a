use super::rows::{Means, Row, settings};
use crate::html;
use std::{collections::BTreeSet, path::PathBuf};
use zipsplat::{Result, types::Image};

const SHOWN: usize = 24;
/// Longer side in pixels.
const PICTURE: u32 = 1008;

pub fn page(means: &Means, rows: &[Row]) -> Result<String> {
    let cells = |line: &[String], tag: &str| {
        line.iter().map(|cell| format!("<{tag}>{}", html::escape(cell))).collect::<String>()
    };
    let mut page = html::begin(&format!("{}, evaluated by its protocol", means.title));
    page += &format!("<table><tr>{}</tr>", cells(&means.headings, "th"));
    means.lines.iter().for_each(|line| page += &format!("<tr>{}</tr>", cells(line, "td")));
    page += "</table><p class=\"note\">P, K: the method was given poses and intrinsics. #Gs: Gaussians. Figures are means over scenes. \
             Each picture has photos that no method has seen above, and what was drawn in their place below.</p>";
    for setting in settings(rows) {
        let of_setting: Vec<&Row> = rows.iter().filter(|row| (row.views, row.rule.as_str()) == setting).collect();
        let scenes: BTreeSet<&str> = of_setting.iter().map(|row| row.scene.as_str()).collect();
        page += &format!("<h2>{} inputs ({})</h2>", setting.0, html::escape(setting.1));
        if scenes.len() > SHOWN {
            page += &format!("<p>The first {SHOWN} of {} scenes.</p>", scenes.len());
        }
        for scene in scenes.into_iter().take(SHOWN) {
            page += &format!("<h3>{}</h3>", html::escape(scene));
            for row in of_setting.iter().filter(|row| row.scene == scene && picture(row).is_file()) {
                page += &figure(row)?;
            }
        }
    }
    Ok(page + "</html>\n")
}

fn picture(row: &Row) -> PathBuf {
    Row::file(&row.place, &row.scene).with_extension("png")
}

fn figure(row: &Row) -> Result<String> {
    let image = Image::open(picture(row))?;
    let lpips = row.lpips.map_or_else(String::new, |lpips| format!(", LPIPS {lpips:.3}"));
    let given = if row.posed { " with cameras" } else { "" };
    let caption = format!(
        "{}{given}: {:.2} dB, SSIM {:.3}{lpips}, {} Gaussians",
        html::escape(&row.method),
        row.psnr,
        row.ssim,
        row.gaussians
    );
    let picture = html::picture(&image, PICTURE)?;
    Ok(format!("<figure><figcaption>{caption}</figcaption><img alt=\"\" src=\"{picture}\"></figure>"))
}
