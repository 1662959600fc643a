use base64::{Engine, engine::general_purpose::STANDARD};
use zipsplat::{
    Result,
    types::{Image, resample::resize_lanczos},
};

const STYLE: &str = include_str!("report.css");
const QUALITY: u8 = 85;

pub fn begin(title: &str) -> String {
    let title = escape(title);
    format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\">\
         <meta name=viewport content=\"width=device-width,initial-scale=1\"><meta name=generator content=zipsplat>\
         <title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    )
}

/// Data URL; the longer side is at most `most` pixels.
pub fn picture(image: &Image, most: u32) -> Result<String> {
    let scale = (f64::from(most) / f64::from(image.width.max(image.height))).min(1.0);
    let [width, height] = [image.width, image.height].map(|side| ((f64::from(side) * scale).round() as u32).max(1));
    let small = resize_lanczos(image, width, height)?;
    Ok(data_url(&small.jpeg(QUALITY)?))
}

pub fn data_url(jpeg: &[u8]) -> String {
    format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg))
}

pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
