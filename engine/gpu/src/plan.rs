//! A recorded plan: commands, and where every tensor lies.

use super::{
    kernel::Module,
    layout::Placement,
    tensor::{Home, Tensor},
};

#[derive(Clone, Copy, Debug)]
pub(super) enum Groups {
    Fixed([u32; 3]),
    /// Three u32 group counts in a tensor.
    Indirect(Tensor),
}

#[derive(Debug)]
pub(super) struct Dispatch {
    pub module: &'static Module,
    pub constants: Vec<u32>,
    pub push: [u32; 16],
    pub buffers: Vec<Tensor>,
    pub groups: Groups,
}

#[derive(Debug)]
pub(super) enum Operation {
    Dispatch(Dispatch),
    Fill { target: Tensor, value: u32 },
    Copy { source: Tensor, target: Tensor },
}

#[derive(Debug)]
pub(super) struct Command {
    pub operation: Operation,
    /// Index into [`Plan::scopes`].
    pub scope: u32,
    /// Multiplications and additions that the arithmetic needs; 0 where bytes matter more.
    pub flops: u64,
}

/// How the host uses an allocation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Scratch,
    /// Written by the host before every run.
    Input,
    /// Keeps its bytes from run to run.
    Constant,
}

#[derive(Debug)]
pub(super) struct Allocation {
    pub name: String,
    pub bytes: u64,
    pub role: Role,
    /// Whether its bytes stay to the end.
    pub kept: bool,
    /// Whether the host reads it, too.
    pub output: bool,
}

/// A recorded command list with its arena laid out: a pure function of shapes.
#[derive(Debug)]
pub struct Plan {
    pub(super) commands: Vec<Command>,
    pub(super) scopes: Vec<String>,
    pub(super) allocations: Vec<Allocation>,
    pub(super) placements: Vec<Placement>,
    pub(super) blocks: Vec<u64>,
    pub(super) observed: Vec<(String, Tensor)>,
}

/// One line of the arena's map.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ArenaRow {
    /// Scope and name of the tensor.
    pub name: String,
    /// Size in bytes.
    pub bytes: u64,
    /// Block it lies in.
    pub block: u32,
    /// Offset in that block.
    pub offset: u64,
    /// Index of the first command that uses it.
    pub first_use: u32,
    /// Index of the last command that uses it.
    pub last_use: u32,
}

impl Plan {
    /// Bytes of each block of the arena.
    pub fn block_bytes(&self) -> &[u64] {
        &self.blocks
    }

    /// Bytes of the arena: the most that is alive at once, as laid out.
    pub fn arena_bytes(&self) -> u64 {
        self.blocks.iter().sum()
    }

    /// Fills every scratch tensor before its first use with what no kernel may rely on: NaN as a float, far out of range as an
    /// index. Memory that a CPU hands out is zero, a GPU's holds what others left there.
    pub(super) fn poison(&mut self) {
        let mut born = vec![Vec::new(); self.commands.len()];
        for (id, (allocation, placement)) in self.allocations.iter().zip(&self.placements).enumerate() {
            let used = (placement.first as usize) < self.commands.len();
            if used && allocation.role == Role::Scratch && allocation.bytes > 0 {
                let target = Tensor { home: Home::Arena(id as u32), offset: 0, bytes: allocation.bytes };
                born[placement.first as usize].push(target);
            }
        }
        let commands = std::mem::take(&mut self.commands);
        for (command, targets) in commands.into_iter().zip(born) {
            for target in targets {
                let operation = Operation::Fill { target, value: u32::MAX };
                self.commands.push(Command { operation, scope: command.scope, flops: 0 });
            }
            self.commands.push(command);
        }
    }

    /// The outermost scope of a command: its stage.
    pub(super) fn stage(&self, command: usize) -> &str {
        let scope = &self.scopes[self.commands[command].scope as usize];
        scope.split('/').next().unwrap_or_default()
    }

    /// Commands in the plan.
    pub fn len(&self) -> usize {
        self.commands.len()
    }

    /// Whether nothing was recorded.
    pub fn is_empty(&self) -> bool {
        self.commands.is_empty()
    }

    /// Arithmetic of all commands.
    pub fn flops(&self) -> u64 {
        self.commands.iter().map(|c| c.flops).sum()
    }

    /// The arena's map, in the order of first use.
    pub fn arena_map(&self) -> Vec<ArenaRow> {
        let mut rows: Vec<_> = self
            .allocations
            .iter()
            .zip(&self.placements)
            .map(|(a, p)| ArenaRow {
                name: a.name.clone(),
                bytes: a.bytes,
                block: p.block,
                offset: p.offset,
                first_use: p.first,
                last_use: p.last,
            })
            .collect();
        rows.sort_by_key(|r| (r.first_use, r.block, r.offset));
        rows
    }
}
