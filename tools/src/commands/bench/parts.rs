use super::{Group, Repeats, Spread, group, peak::Rate, percent};
use crate::{session::Stage, table::Table};
use serde::Serialize;
use std::time::Instant;
use zipsplat::{
    Result,
    gpu::{Profile, ProfileRow, Run},
};

#[derive(Clone, Default, Serialize)]
pub struct Part {
    /// Empty for all.
    pub stage: String,
    /// Empty for all.
    pub kernel: String,
    pub commands: u32,
    pub ms: Spread,
    pub gflop: f64,
    pub gflop_per_s: f64,
    /// Absent without significant arithmetic.
    pub peak_share: Option<f64>,
}

impl Part {
    fn new(stage: &str, kernel: &str, group: Group, peak: &Rate) -> Self {
        let rate = group.ms.rate(group.flops);
        Self {
            stage: stage.to_owned(),
            kernel: kernel.to_owned(),
            commands: group.count,
            ms: group.ms,
            gflop: group.flops as f64 / 1e9,
            gflop_per_s: rate,
            peak_share: peak.share(rate),
        }
    }
}

/// The whole on the host, parts by timestamps. `write` uploads each run's inputs.
pub fn measure(
    run: &mut Run,
    write: impl Fn(&mut Run) -> Result<()>,
    stage_of: fn(&ProfileRow) -> String,
    repeats: Repeats,
    peak: &Rate,
    stage: &Stage<'_>,
) -> Result<Vec<Part>> {
    let Repeats { warmup, repeats } = repeats;
    let (mut totals, mut profiles): (Vec<_>, Vec<Profile>) = Default::default();
    for i in 0..warmup + repeats {
        let done = f64::from(i) / f64::from(warmup + repeats);
        stage.reach(done)?;
        write(run)?;
        let start = Instant::now();
        run.execute_with(|_| stage.at(done))?;
        if i >= warmup {
            totals.push(start.elapsed());
            write(run)?;
            profiles.push(run.profile()?);
        }
    }
    let plan = run.plan();
    let all = Group { count: plan.len() as u32, flops: plan.flops(), ..Group::of("", Spread::of(totals)) };
    let mut parts = vec![Part::new("", "", all, peak)];
    for of_stage in group(&profiles, stage_of) {
        let stage = of_stage.name.clone();
        parts.push(Part::new(&stage, "", of_stage, peak));
        let only = |profile: &Profile| Profile {
            rows: profile.rows.iter().filter(|row| stage_of(row) == stage).cloned().collect(),
        };
        let inside: Vec<Profile> = profiles.iter().map(only).collect();
        for of_kernel in group(&inside, |row| row.kernel.clone()) {
            let kernel = of_kernel.name.clone();
            parts.push(Part::new(&stage, &kernel, of_kernel, peak));
        }
    }
    Ok(parts)
}

pub fn table<'a>(parts: impl IntoIterator<Item = &'a Part>) -> Table {
    let headings = ["stage", "kernel", "commands", "ms: median (min..max)", "GFLOP", "GFLOP/s", "of peak"];
    let mut table = Table::new(2, &headings);
    for part in parts {
        let stage = match (part.stage.as_str(), part.kernel.as_str()) {
            ("", _) => "all, as the host sees it",
            (stage, "") => stage,
            _ => "",
        };
        table.row([
            stage.to_owned(),
            part.kernel.clone(),
            part.commands.to_string(),
            part.ms.to_string(),
            format!("{:.3}", part.gflop),
            format!("{:.1}", part.gflop_per_s),
            percent(part.peak_share),
        ]);
    }
    table
}
