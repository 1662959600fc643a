use crate::{outputs::MADE_BY, photos::folders_in, protocol::Protocol, stamp::entries};
use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};
use zipsplat::Result;

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    pub generator: String,
    pub protocol: String,
    pub method: String,
    pub posed: bool,
    pub scene: String,
    pub views: usize,
    /// Frame selection, such as `gap50`.
    pub rule: String,
    /// Hash of the inputs of the scores.
    pub hash: String,
    pub targets: usize,
    pub gaussians: usize,
    pub psnr: f64,
    pub ssim: f64,
    pub lpips: Option<f64>,
    pub seconds: Option<f64>,
    #[serde(skip)]
    pub place: PathBuf,
}

impl Row {
    pub fn file(folder: &Path, scene: &str) -> PathBuf {
        folder.join(format!("{scene}.json"))
    }

    pub fn read(file: &Path) -> Option<Self> {
        let row: Self = serde_json::from_slice(&std::fs::read(file).ok()?).ok()?;
        let place = file.parent()?.to_owned();
        (row.generator == MADE_BY).then_some(Self { place, ..row })
    }
}

pub fn read_all(folder: &Path, protocol: Protocol) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for way in folders_in(folder)? {
        for setting in folders_in(&way)? {
            let mut found: Vec<Row> = entries(&setting)?.iter().filter_map(|file| Row::read(file)).collect();
            found.retain(|row| row.protocol == name_of(protocol));
            found.sort_by(|a, b| a.scene.cmp(&b.scene));
            rows.extend(found);
        }
    }
    Ok(rows)
}

pub fn name_of(protocol: Protocol) -> String {
    protocol.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
}

/// Numbers of views and rules, sorted.
pub fn settings(rows: &[Row]) -> BTreeSet<(usize, &str)> {
    rows.iter().map(|row| (row.views, row.rule.as_str())).collect()
}

pub struct Means {
    pub title: String,
    pub headings: Vec<String>,
    pub lines: Vec<Vec<String>>,
}

impl Means {
    pub fn of(protocol: Protocol, rows: &[Row]) -> Self {
        let settings = settings(rows);
        let mut ways: Vec<&Path> = rows.iter().filter_map(|row| row.place.parent()).collect();
        ways.dedup();
        let mut headings = ["Method", "P", "K"].map(str::to_owned).to_vec();
        for (views, rule) in &settings {
            let alone = settings.iter().filter(|(other, _)| other == views).count() == 1;
            let setting = if alone { format!("{views}v") } else { format!("{views}v {rule}") };
            headings.extend(["scenes", "#Gs", "PSNR", "SSIM", "LPIPS"].map(|what| format!("{setting} {what}")));
        }
        let line = |way: &&Path| {
            let of_way = rows.iter().filter(|row| row.place.parent() == Some(way));
            let of_way: Vec<&Row> = of_way.collect();
            let known = if of_way[0].posed { "✓" } else { "" };
            let mut line = vec![of_way[0].method.clone(), known.into(), known.into()];
            for (views, rule) in &settings {
                let found = of_way.iter().filter(|row| row.views == *views && row.rule == *rule);
                line.extend(cells(&found.copied().collect::<Vec<_>>()));
            }
            line
        };
        Self { title: protocol.title().into(), headings, lines: ways.iter().map(line).collect() }
    }

    pub fn markdown(&self) -> String {
        let row = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule = self.headings.iter().enumerate().map(|(i, _)| if i < 3 { "---" } else { "---:" }.to_owned());
        let mut text = format!("<!-- {MADE_BY} -->\n# {}\n\n", self.title) + &row(&self.headings);
        text += &row(&rule.collect::<Vec<_>>());
        self.lines.iter().for_each(|line| text += &row(line));
        text
    }

    pub fn csv(&self) -> String {
        let mut table = csv::Writer::from_writer(Vec::new());
        let lines = std::iter::once(&self.headings).chain(&self.lines);
        lines.for_each(|line| table.write_record(line).expect("rows of one length, written to memory"));
        String::from_utf8(table.into_inner().expect("written to memory")).expect("fields are text")
    }
}

fn cells(rows: &[&Row]) -> [String; 5] {
    if rows.is_empty() {
        return Default::default();
    }
    let count = rows.len() as f64;
    let mean = |of: fn(&Row) -> f64| rows.iter().map(|row| of(row)).sum::<f64>() / count;
    let lpips = rows.iter().map(|row| row.lpips).sum::<Option<f64>>().map(|sum| sum / count);
    [
        rows.len().to_string(),
        short(mean(|row| row.gaussians as f64)),
        format!("{:.2}", mean(|row| row.psnr)),
        format!("{:.3}", mean(|row| row.ssim)),
        lpips.map_or_else(String::new, |lpips| format!("{lpips:.3}")),
    ]
}

/// Formats as the paper's tables: `820`, `62K`, `1.3M`.
fn short(count: f64) -> String {
    match count {
        ..1e3 => format!("{count:.0}"),
        ..999.5e3 => format!("{:.0}K", count / 1e3),
        _ => format!("{:.1}M", count / 1e6),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_as_short_as_the_papers() {
        let found = [820.0, 62_208.0, 248_832.0, 999_700.0, 1_327_104.0].map(short);
        assert_eq!(found, ["820", "62K", "249K", "1.0M", "1.3M"]);
    }
}
