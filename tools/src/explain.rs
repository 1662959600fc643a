use crate::table::{Table, bytes};
use serde::Serialize;
use std::{fmt, time::Duration};
use zipsplat::{
    gpu::{Profile, ProfileRow, StageTimes},
    types::SkippedPass,
};

#[derive(Serialize)]
pub struct Explanation {
    passes: Vec<Pass>,
    skipped_passes: Vec<SkippedPass>,
}

#[derive(Serialize)]
struct Pass {
    pass: String,
    commands: u32,
    seconds: f64,
    /// Tensor bytes read and written, each once per command.
    bytes: u64,
}

impl Explanation {
    pub fn of_kernels(profile: &Profile, skipped_passes: Vec<SkippedPass>) -> Self {
        let pass = |row: &ProfileRow| {
            let pass = if row.kernel.starts_with(&row.scope) {
                row.kernel.clone()
            } else {
                format!("{}: {}", row.scope, row.kernel)
            };
            Pass { pass, commands: row.count, seconds: row.time.as_secs_f64(), bytes: row.bytes }
        };
        Self { passes: profile.rows.iter().map(pass).collect(), skipped_passes }
    }

    pub fn of_stages(times: &StageTimes, outline: &Profile, skipped_passes: Vec<SkippedPass>) -> Self {
        let pass = |(stage, time): &(String, Duration)| {
            let inside = |row: &&ProfileRow| row.scope.split('/').next() == Some(stage);
            let (commands, bytes) = outline
                .rows
                .iter()
                .filter(inside)
                .fold((0, 0), |(count, bytes), row| (count + row.count, bytes + row.bytes));
            Pass { pass: stage.clone(), commands, seconds: time.as_secs_f64(), bytes }
        };
        Self { passes: times.0.iter().map(pass).collect(), skipped_passes }
    }
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = Table::new(1, &["pass", "commands", "ms", "bytes"]);
        for pass in &self.passes {
            let ms = format!("{:.3}", 1e3 * pass.seconds);
            table.row([pass.pass.clone(), pass.commands.to_string(), ms, bytes(pass.bytes)]);
        }
        let seconds: f64 = self.passes.iter().map(|pass| pass.seconds).sum();
        let commands: u32 = self.passes.iter().map(|pass| pass.commands).sum();
        let moved: u64 = self.passes.iter().map(|pass| pass.bytes).sum();
        table.row(["together".into(), commands.to_string(), format!("{:.3}", 1e3 * seconds), bytes(moved)]);
        write!(f, "{table}")?;
        if self.skipped_passes.is_empty() {
            return Ok(());
        }
        let mut table = Table::new(2, &["left out", "why"]);
        self.skipped_passes.iter().for_each(|left| table.row([left.what.clone(), left.why.clone()]));
        write!(f, "\n{table}")
    }
}
