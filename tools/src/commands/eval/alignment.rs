use crate::{
    align::{Aligned, Doubt, MOST_SHIFT, MOST_TURN},
    capture::{Score, ViewSplit},
    table::Table,
};
use serde::Serialize;
use zipsplat::types::median;

#[derive(Serialize)]
pub struct AlignedScore {
    view: String,
    psnr: f64,
    ssim: f64,
    nearest_psnr: f64,
    mean_color_psnr: f64,
    pub lpips: Option<f64>,
    unaligned_psnr: f64,
    unaligned_ssim: f64,
    rotation_error_deg: f64,
    /// In the cameras' unit.
    translation_error: f64,
    warning: Option<Doubt>,
}

fn scores(capture: &ViewSplit, found: &[Aligned]) -> Vec<AlignedScore> {
    let scores = |picture: fn(&Aligned) -> &Vec<f32>| {
        capture.scores(&found.iter().map(|found| picture(found).clone()).collect::<Vec<_>>())
    };
    let (before, after) = (scores(|found| &found.before), scores(|found| &found.drawn));
    let row = |((found, before), score): ((&Aligned, Score), Score)| AlignedScore {
        unaligned_psnr: before.psnr,
        unaligned_ssim: before.ssim,
        rotation_error_deg: found.turn.to_degrees(),
        translation_error: capture.scene_scale.length * found.shift,
        warning: found.doubt.or((score.psnr <= score.mean_color_psnr).then_some(Doubt::Color)),
        view: score.view,
        psnr: score.psnr,
        ssim: score.ssim,
        nearest_psnr: score.nearest_psnr,
        mean_color_psnr: score.mean_color_psnr,
        lpips: None,
    };
    found.iter().zip(before).zip(after).map(row).collect()
}

#[derive(Serialize)]
pub struct Alignment {
    rotation_error_deg: f64,
    translation_error: f64,
    unaligned: Unaligned,
    unreliable: usize,
    pub rows: Vec<AlignedScore>,
}

#[derive(Serialize)]
struct Unaligned {
    psnr: f64,
    ssim: f64,
}

impl Alignment {
    pub fn new(capture: &ViewSplit, found: &[Aligned]) -> Self {
        let rows = scores(capture, found);
        let median = |value: fn(&AlignedScore) -> f64| median(rows.iter().map(value)).unwrap_or(f64::NAN);
        let mean = |value: fn(&AlignedScore) -> f64| rows.iter().map(value).sum::<f64>() / rows.len() as f64;
        Self {
            rotation_error_deg: median(|row| row.rotation_error_deg),
            translation_error: median(|row| row.translation_error),
            unaligned: Unaligned { psnr: mean(|row| row.unaligned_psnr), ssim: mean(|row| row.unaligned_ssim) },
            unreliable: rows.iter().filter(|row| row.warning.is_some()).count(),
            rows,
        }
    }

    pub fn table(&self, mean: &Score) -> Table {
        let mut table = Table::new(
            1,
            &["view", "PSNR", "SSIM", "LPIPS", "nearest photo", "mean color", "degrees", "distance", "warning"],
        );
        for row in &self.rows {
            let score = [row.psnr, row.ssim, row.nearest_psnr, row.mean_color_psnr];
            let [view, psnr, ssim, lpips, nearest, color] = cells(&row.view, score, row.lpips);
            let doubt = match row.warning {
                None => "",
                Some(Doubt::Flat) => "flat",
                Some(Doubt::Bound) => "bound",
                Some(Doubt::Color) => "color",
            };
            let [degrees, distance] =
                [format!("{:.2}", row.rotation_error_deg), format!("{:.4}", row.translation_error)];
            table.row([view, psnr, ssim, lpips, nearest, color, degrees, distance, doubt.into()]);
        }
        let [view, psnr, ssim, lpips, nearest, color] = cells_of(mean);
        table.row([view, psnr, ssim, lpips, nearest, color, String::new(), String::new(), String::new()]);
        table
    }

    pub fn doubts(&self) -> Option<String> {
        let count = |doubt| self.rows.iter().filter(|row| row.warning == Some(doubt)).count();
        let [flat, bound, color] = [Doubt::Flat, Doubt::Bound, Doubt::Color].map(count);
        let reasons = [
            (flat, "of a photo without texture, which is not aligned".to_owned()),
            (
                bound,
                format!(
                    "with a camera at the bound of {:.0} degrees or {MOST_SHIFT} of the network's unit",
                    MOST_TURN.to_degrees()
                ),
            ),
            (color, "no more like its photo than one color".to_owned()),
        ];
        let reasons: Vec<String> = (reasons.iter().filter(|(count, _)| *count > 0))
            .map(|(count, reason)| format!("{count} {reason}"))
            .collect();
        let of = self.rows.len();
        (self.unreliable > 0)
            .then(|| format!("{} of {of} aligned pictures say little: {}", self.unreliable, reasons.join("; ")))
    }

    pub fn summary(&self) -> String {
        let Self {
            rotation_error_deg: degrees, translation_error: distance, unaligned: Unaligned { psnr, ssim }, ..
        } = self;
        format!(
            "\naligned by {degrees:.2} degrees and {distance:.4} (medians); with the cameras given {psnr:.2} dB and {ssim:.3}"
        )
    }
}

pub fn cells_of(score: &Score) -> [String; 6] {
    cells(&score.view, [score.psnr, score.ssim, score.nearest_psnr, score.mean_color_psnr], score.lpips)
}

fn cells(view: &str, [psnr, ssim, nearest, color]: [f64; 4], lpips: Option<f64>) -> [String; 6] {
    let db = |value: f64| format!("{value:.2} dB");
    let lpips = lpips.map_or("-".into(), |lpips| format!("{lpips:.3}"));
    [view.to_owned(), db(psnr), format!("{ssim:.3}"), lpips, db(nearest), db(color)]
}
