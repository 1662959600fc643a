//! Splits plans into submissions of similar cost.

use crate::{
    Limits,
    plan::{Command, Operation, Plan},
};
use std::time::Duration;

/// Target time of a submission: hides its overhead, far below watchdogs' 2 s.
pub(crate) const SUBMISSION: Duration = Duration::from_millis(100);

/// FLOPs in one byte's transfer time, roughly on CPUs and GPUs alike.
const FLOPS_PER_BYTE: u64 = 4;

pub(crate) const MAX_PIECES: usize = 1024;

/// Below most devices of its kind, to keep the first submissions short.
pub(crate) fn first_guess(limits: &Limits) -> u64 {
    match (limits.cpu, limits.discrete) {
        (true, _) => 10_000_000,
        (_, true) => 1_000_000_000,
        _ => 100_000_000,
    }
}

/// `late`: it may have ended earlier, so `took` is an upper bound. `patient`: CPUs, which compile
/// kernels during first submissions and have no watchdog.
pub(crate) fn learned(known: u64, cost: u64, took: Duration, late: bool, patient: bool) -> u64 {
    let (known, ms) = (known as f64, 1e3 * took.as_secs_f64());
    // Fixed overhead dominates below a millisecond: such a time is only a lower bound on speed.
    let seen = cost as f64 / ms.max(1.0);
    if seen < known && (late || ms < 1.0) {
        return known as u64;
    }
    let next = if took > 2 * SUBMISSION && !patient {
        seen.clamp(known / 8.0, known)
    } else {
        0.5 * (known + seen.clamp(known / 2.0, known * 2.0))
    };
    next.max(1e5) as u64
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Piece {
    pub command: usize,
    /// First workgroup and count along each axis; dispatches only.
    pub base: [u32; 3],
    pub groups: [u32; 3],
}

/// The next command and its completed workgroups along the split axis.
#[derive(Clone, Copy, Default)]
pub(crate) struct Cursor {
    pub command: usize,
    done: u32,
}

impl Command {
    pub(crate) fn bytes(&self) -> u64 {
        let mut bytes = 0;
        self.operation.for_each_access(|tensor, _, _| bytes += tensor.bytes);
        bytes
    }

    pub(crate) fn cost(&self) -> u64 {
        self.flops.max(self.bytes() * FLOPS_PER_BYTE)
    }
}

impl Cursor {
    pub fn next_pieces(&mut self, plan: &Plan, budget: u64) -> (Vec<Piece>, u64) {
        let (first, mut pieces, mut cost) = (self.command, Vec::new(), 0);
        while cost < budget && pieces.len() < MAX_PIECES {
            let Some(command) = plan.commands.get(self.command) else { break };
            if plan.stage(self.command) != plan.stage(first) {
                break;
            }
            let (piece, piece_cost, whole) = self.next_piece(command, budget - cost);
            pieces.push(piece);
            cost += piece_cost;
            if !whole {
                break;
            }
            *self = Self { command: self.command + 1, done: 0 };
        }
        (pieces, cost)
    }

    fn next_piece(&mut self, command: &Command, budget: u64) -> (Piece, u64, bool) {
        let mut piece = Piece { command: self.command, base: [0; 3], groups: [1; 3] };
        let Operation::Dispatch(dispatch) = &command.operation else { return (piece, command.cost(), true) };
        let groups = dispatch.groups;
        let axis = longest_axis(groups);
        let per_group = (command.cost() / groups[axis] as u64).max(1);
        let count = (budget / per_group).clamp(1, (groups[axis] - self.done) as u64) as u32;
        piece.groups = groups;
        piece.base[axis] = self.done;
        piece.groups[axis] = count;
        self.done += count;
        (piece, per_group * count as u64, self.done == groups[axis])
    }
}

/// Kernels use only group indices, so folded dispatches may be split along x, too.
fn longest_axis(groups: [u32; 3]) -> usize {
    (0..3).rev().max_by_key(|&i| groups[i]).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Binding, Kernel, Limits, LocalSize, Module, Needs, Recorder, Tensor};

    struct Idle {
        values: Tensor,
    }

    impl Kernel for Idle {
        fn module(&self) -> &'static Module {
            static IDLE: Module = Module {
                name: "idle",
                spirv: &[],
                bindings: &[Binding { name: "values", binding: 0, reads: true, writes: true }],
                push_bytes: 0,
                addresses: &[],
                constant_ids: &[],
                local_size: LocalSize::Fixed([64, 1, 1]),
                needs: Needs { half_storage: false, matrices: None, conversions: false, dot_products: false },
            };
            &IDLE
        }

        fn buffers(&self) -> Vec<Tensor> {
            vec![self.values]
        }

        fn push(&self) -> [u32; 16] {
            [0; 16]
        }

        fn constants(&self) -> Vec<u32> {
            Vec::new()
        }
    }

    fn submissions(flops_per_ms: f64, limits: &Limits) -> Vec<Duration> {
        let mut known = first_guess(limits);
        let mut submit = |_| {
            let cost = known * SUBMISSION.as_millis() as u64;
            let took = Duration::from_secs_f64(cost as f64 / flops_per_ms / 1e3);
            known = learned(known, cost, took, false, limits.cpu);
            took
        };
        (0..30).map(&mut submit).collect()
    }

    #[test]
    fn submissions_settle_at_their_length() {
        let kind = |cpu, discrete| Limits { cpu, discrete, ..Limits::default() };
        for (flops_per_ms, limits) in [(2e6, kind(true, false)), (2e7, kind(false, false)), (1e8, kind(false, true))] {
            let times = submissions(flops_per_ms, &limits);
            assert!(times[0] <= Duration::from_secs(1), "{flops_per_ms}: first {:?}", times[0]);
            assert!(times[10..].iter().all(|took| *took <= 2 * SUBMISSION), "{flops_per_ms}: {times:?}");
            assert!(limits.cpu || times[3] <= 2 * SUBMISSION, "{flops_per_ms}: {times:?}");
        }
        let times = submissions(5e11, &kind(false, true));
        assert!(times[29] > SUBMISSION / 2 && times[29] <= 2 * SUBMISSION, "{times:?}");
    }

    #[test]
    fn what_says_nothing_of_the_speed_changes_nothing() {
        let known = 1_000_000;
        assert_eq!(learned(known, 10, Duration::from_micros(50), false, false), known);
        assert_eq!(learned(known, 10, Duration::from_secs(3), true, false), known);
        assert!(learned(known, 10 * known, Duration::from_micros(50), true, false) > known);
    }

    fn least_cost(command: &Command) -> u64 {
        match &command.operation {
            Operation::Dispatch(d) => command.cost() / u64::from(d.groups.into_iter().max().unwrap_or(1)),
            _ => command.cost(),
        }
    }

    #[test]
    fn pieces_cover_a_plan_once() {
        let mut rec = Recorder::new(&Limits::default());
        let values = rec.input::<f32>("values", 1 << 20);
        let shapes = [[1, 1, 1], [100, 1, 1], [32768, 7, 1], [4000, 24, 1], [3, 50, 1], [4, 6, 9], [1, 1, 65535]];
        for (i, groups) in shapes.into_iter().enumerate() {
            rec.scope(if i < 3 { "first" } else { "second" }, |rec| {
                rec.dispatch_groups(Idle { values }, groups);
                rec.fill(values, 0);
            });
        }
        let plan = rec.finish().expect("it fits");
        for budget in [1, 1 << 20, 1 << 24, u64::MAX] {
            let mut cursor = Cursor::default();
            let mut covered = vec![0u64; plan.commands.len()];
            while cursor.command < plan.commands.len() {
                let (pieces, cost) = cursor.next_pieces(&plan, budget);
                assert!(!pieces.is_empty());
                let least = pieces.iter().map(|piece| least_cost(&plan.commands[piece.command])).max().unwrap_or(0);
                assert!(cost <= budget.saturating_add(least), "found {cost}, expected {budget} or {least} more");
                for piece in &pieces {
                    assert_eq!(plan.stage(piece.command), plan.stage(pieces[0].command));
                    covered[piece.command] += piece.groups.iter().map(|g| *g as u64).product::<u64>();
                }
            }
            for (command, covered) in plan.commands.iter().zip(covered) {
                let whole = match &command.operation {
                    Operation::Dispatch(d) => d.groups.iter().map(|g| *g as u64).product(),
                    _ => 1,
                };
                assert_eq!(covered, whole, "budget {budget}");
            }
        }
    }
}
