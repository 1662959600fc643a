use super::schedule::{Cursor, MAX_PIECES};
use crate::{
    Result, Run,
    device::failure::driver,
    plan::{Command, Operation, Plan},
};
use ash::vk;
use std::{collections::HashMap, time::Duration};

/// Device time of a run by scope and kernel.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct Profile {
    /// Rows in order of first use.
    pub rows: Vec<ProfileRow>,
}

/// Commands of one kernel in one scope.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ProfileRow {
    /// Scope path, such as `backbone/block`.
    pub scope: String,
    /// Kernel name, `fill` or `copy`.
    pub kernel: String,
    /// Number of commands.
    pub count: u32,
    /// Total device time.
    pub time: Duration,
    /// FLOPs.
    pub flops: u64,
    /// Bytes of the tensors read and written.
    pub bytes: u64,
}

impl Profile {
    /// Sums time and FLOPs of scopes that start with `prefix`.
    pub fn total(&self, prefix: &str) -> (Duration, u64) {
        self.rows
            .iter()
            .filter(|r| r.scope.starts_with(prefix))
            .fold((Duration::ZERO, 0), |(time, flops), r| (time + r.time, flops + r.flops))
    }

    /// Adds another run's rows to those of the same scope and kernel.
    pub fn add(&mut self, other: &Self) {
        for row in &other.rows {
            match self.rows.iter_mut().find(|own| (&own.scope, &own.kernel) == (&row.scope, &row.kernel)) {
                Some(own) => {
                    own.count += row.count;
                    own.time += row.time;
                    own.flops += row.flops;
                    own.bytes += row.bytes;
                }
                None => self.rows.push(row.clone()),
            }
        }
    }

    /// Returns rows with zero times.
    pub fn outline(plan: &Plan) -> Self {
        Self::new(plan, &vec![0.0; plan.len()])
    }

    pub(crate) fn new(plan: &Plan, nanoseconds: &[f64]) -> Self {
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

impl Run {
    /// Runs the plan with a timestamp around every command, which prevents overlap.
    ///
    /// # Errors
    /// As [`Run::execute`]; [`Error::NoDevice`](crate::Error::NoDevice) without timestamps.
    pub fn profile(&mut self) -> Result<Profile> {
        self.device.limits().check_timestamps()?;
        self.begin()?;
        if let Some(upload) = self.staging.as_ref().map(|staging| staging.upload) {
            let value = self.submit(upload)?;
            self.lane.wait(value)?;
        }
        let raw = self.device.0.raw.clone();
        let count = 2 * MAX_PIECES as u32;
        let info = vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(count);
        // SAFETY: destroyed below, after waiting for the last submission.
        let queries = unsafe { raw.create_query_pool(&info, None) }.map_err(|e| driver("vkCreateQueryPool", e))?;
        let times = self.profiled(queries, count);
        // SAFETY: `profiled` waits for all its submissions, even on failure.
        unsafe { raw.destroy_query_pool(queries, None) };
        // A failed run may have overwritten them.
        self.forget_inputs();
        let times = times?;
        self.device.0.check_messages()?;
        Ok(Profile::new(&self.plan, &times))
    }

    fn profiled(&mut self, queries: vk::QueryPool, count: u32) -> Result<Vec<f64>> {
        let device = self.device.clone();
        let (raw, limits) = (&device.0.raw, device.limits());
        let mut times = vec![0.0; self.plan.commands.len()];
        let mut cursor = Cursor::default();
        let commands = self.command_buffer()?;
        while cursor.command < self.plan.commands.len() {
            let (pieces, _) = cursor.next_pieces(&self.plan, self.budget(cursor.command));
            self.record(commands, &pieces, Some((queries, count)))?;
            let value = self.submit(commands)?;
            self.lane.wait(value)?;
            let mut stamps = vec![0u64; 2 * pieces.len()];
            // SAFETY: the submission that wrote these queries is done.
            unsafe { raw.get_query_pool_results(queries, 0, &mut stamps, vk::QueryResultFlags::TYPE_64) }
                .map_err(|e| self.device.0.failed("vkGetQueryPoolResults", e))?;
            for (piece, t) in pieces.iter().zip(stamps.chunks_exact(2)) {
                let ticks = t[1].wrapping_sub(t[0]) & (u64::MAX >> (64 - limits.timestamp_bits));
                times[piece.command] += ticks as f64 * limits.timestamp_ns;
            }
        }
        // SAFETY: no longer in use.
        unsafe { raw.free_command_buffers(self.pool, &[commands]) };
        Ok(times)
    }
}
