//! Where the time of a run went.

use super::plan::{Command, Operation, Plan};
use std::{collections::HashMap, time::Duration};

/// Device time of a run, by scope and kernel.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct Profile {
    /// One row for each kernel of each scope, in the order of first use.
    pub rows: Vec<ProfileRow>,
}

/// Commands of one kernel in one scope.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ProfileRow {
    /// Scope path, such as `backbone/block`.
    pub scope: String,
    /// Kernel name, or `fill` or `copy`.
    pub kernel: String,
    /// Commands.
    pub count: u32,
    /// Device time of all of them.
    pub time: Duration,
    /// Arithmetic they had to do.
    pub flops: u64,
    /// Bytes of the tensors that they read and wrote, each counted once a command.
    pub bytes: u64,
}

impl Profile {
    /// Time and arithmetic of rows whose scope starts with `prefix`.
    pub fn total(&self, prefix: &str) -> (Duration, u64) {
        self.rows
            .iter()
            .filter(|r| r.scope.starts_with(prefix))
            .fold((Duration::ZERO, 0), |(time, flops), r| (time + r.time, flops + r.flops))
    }

    /// The rows of a plan that has not run: their times are zero.
    pub fn outline(plan: &Plan) -> Self {
        Self::new(plan, &vec![0.0; plan.len()])
    }

    pub(super) fn new(plan: &Plan, nanoseconds: &[f64]) -> Self {
        let mut rows: Vec<ProfileRow> = Vec::new();
        let mut known = HashMap::new();
        for (command, ns) in plan.commands.iter().zip(nanoseconds) {
            let kernel = kernel_name(command);
            let row = *known.entry((command.scope, kernel)).or_insert_with(|| {
                let scope = plan.scopes[command.scope as usize].clone();
                let (kernel, time) = (kernel.to_owned(), Duration::ZERO);
                rows.push(ProfileRow { scope, kernel, count: 0, time, flops: 0, bytes: 0 });
                rows.len() - 1
            });
            rows[row].count += 1;
            rows[row].time += Duration::from_nanos(*ns as u64);
            rows[row].flops += command.flops;
            rows[row].bytes += command.bytes();
        }
        Self { rows }
    }
}

fn kernel_name(command: &Command) -> &'static str {
    match &command.operation {
        Operation::Dispatch(dispatch) => dispatch.module.name,
        Operation::Fill { .. } => "fill",
        Operation::Copy { .. } => "copy",
    }
}
