//! Cuts a plan into submissions of about equal cost, so that no driver takes one for a hang.

use super::plan::{Command, Groups, Operation, Plan};

/// Arithmetic that takes as long as moving a byte, roughly, on CPUs and GPUs alike.
const FLOPS_PER_BYTE: u64 = 4;

/// Most pieces of one submission.
pub(super) const MAX_PIECES: usize = 1024;

/// Part of a command: all of it, or some of a long dispatch's workgroups.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece {
    /// Index of the command in its plan.
    pub command: usize,
    /// First workgroup and count along each axis; unused for other operations.
    pub base: [u32; 3],
    pub groups: [u32; 3],
}

/// Where scheduling stands: the next command, and how many of its workgroups along the axis that is cut are done.
#[derive(Clone, Copy, Default)]
pub(super) struct Cursor {
    pub command: usize,
    done: u32,
}

impl Command {
    /// Bytes of everything that the command touches.
    pub(super) fn bytes(&self) -> u64 {
        let mut bytes = 0;
        self.operation.for_each_access(|tensor, _, _| bytes += tensor.bytes);
        bytes
    }

    /// Arithmetic that takes about as long as the command.
    pub(super) fn cost(&self) -> u64 {
        self.flops.max(self.bytes() * FLOPS_PER_BYTE)
    }
}

impl Cursor {
    /// A cursor past everything in `plan`.
    pub fn at_end(plan: &Plan) -> Self {
        Self { command: plan.commands.len(), done: 0 }
    }

    /// Takes pieces of one stage that cost about `budget` together, and says what they cost. A dispatch beyond the
    /// budget is cut along its longest axis.
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

    /// As much of the command as `room` has space for, its cost, and whether that is the rest of it.
    fn next_piece(&mut self, command: &Command, room: u64) -> (Piece, u64, bool) {
        let mut piece = Piece { command: self.command, base: [0; 3], groups: [1; 3] };
        let Operation::Dispatch(dispatch) = &command.operation else { return (piece, command.cost(), true) };
        let Groups::Fixed(groups) = dispatch.groups else { return (piece, command.cost(), true) };
        let axis = cut_axis(groups);
        let per_group = (command.cost() / groups[axis] as u64).max(1);
        let count = (room / per_group).clamp(1, (groups[axis] - self.done) as u64) as u32;
        piece.groups = groups;
        piece.base[axis] = self.done;
        piece.groups[axis] = count;
        self.done += count;
        (piece, per_group * count as u64, self.done == groups[axis])
    }
}

/// The longest axis; of a folded dispatch, which counts its groups along x, the rows.
fn cut_axis(groups: [u32; 3]) -> usize {
    let longest = (0..3).rev().max_by_key(|&i| groups[i]).unwrap_or(0);
    if groups[1] > 1 && groups[2] == 1 { longest.max(1) } else { longest }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        gpu::{Limits, Recorder},
        kernels::ops::Add,
    };

    /// Every workgroup of every command is in exactly one piece, whatever the budget.
    #[test]
    fn pieces_cover_a_plan_once() {
        let mut rec = Recorder::new(&Limits::default());
        let left = rec.input::<f32>("left", 1 << 20);
        let right = rec.input::<f32>("right", 1 << 20);
        let shapes = [[1, 1, 1], [100, 1, 1], [32768, 7, 1], [3, 50, 1], [4, 6, 9], [1, 1, 65535]];
        for (i, groups) in shapes.into_iter().enumerate() {
            rec.scope(if i < 3 { "first" } else { "second" }, |rec| {
                rec.dispatch_groups(Add { left, right, out: left, count: 1 << 20 }, groups);
                rec.fill(right, 0);
            });
        }
        let plan = rec.finish().expect("it fits");
        for budget in [1, 1 << 20, 1 << 24, u64::MAX] {
            let mut cursor = Cursor::default();
            let mut covered = vec![0u64; plan.commands.len()];
            while cursor.command < plan.commands.len() {
                let (pieces, _) = cursor.next_pieces(&plan, budget);
                assert!(!pieces.is_empty());
                for piece in &pieces {
                    assert_eq!(plan.stage(piece.command), plan.stage(pieces[0].command));
                    covered[piece.command] += piece.groups.iter().map(|g| *g as u64).product::<u64>();
                }
            }
            for (command, covered) in plan.commands.iter().zip(covered) {
                let whole = match &command.operation {
                    Operation::Dispatch(d) => match d.groups {
                        Groups::Fixed(groups) => groups.iter().map(|g| *g as u64).product(),
                        Groups::Indirect(_) => 1,
                    },
                    _ => 1,
                };
                assert_eq!(covered, whole, "budget {budget}");
            }
        }
    }
}
