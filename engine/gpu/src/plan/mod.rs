pub(crate) mod kernel;
pub(crate) mod layout;
mod recorder;

pub use kernel::{Binding, Kernel, LocalSize, Module, Needs};
pub use recorder::{GROUP_FOLD, Recorder};

use self::layout::Placement;
use crate::memory::tensor::{Home, Tensor};

#[derive(Debug)]
pub(crate) struct Dispatch {
    pub module: &'static Module,
    pub constants: Vec<u32>,
    pub push: [u32; 16],
    pub buffers: Vec<Tensor>,
    pub groups: [u32; 3],
}

#[derive(Debug)]
pub(crate) enum Operation {
    Dispatch(Dispatch),
    Fill { target: Tensor, value: u32 },
    Copy { source: Tensor, target: Tensor },
}

#[derive(Debug)]
pub(crate) struct Command {
    pub operation: Operation,
    pub scope: u32,
    /// 0 for commands bound by memory.
    pub flops: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Scratch,
    Input,
    Constant,
}

#[derive(Debug)]
pub(crate) struct Allocation {
    pub name: String,
    pub bytes: u64,
    pub role: Role,
    pub kept: bool,
    pub output: bool,
}

/// A recorded command list with its arena layout: a pure function of shapes.
#[derive(Debug)]
pub struct Plan {
    pub(crate) commands: Vec<Command>,
    pub(crate) scopes: Vec<String>,
    pub(crate) allocations: Vec<Allocation>,
    pub(crate) placements: Vec<Placement>,
    pub(crate) blocks: Vec<u64>,
    pub(crate) observed: Vec<(String, Tensor)>,
}

/// A row of the arena map.
#[derive(Clone, Debug, serde::Serialize)]
pub struct ArenaRow {
    /// Scope and name.
    pub name: String,
    /// Size in bytes.
    pub bytes: u64,
    /// Block index.
    pub block: u32,
    /// Offset in the block.
    pub offset: u64,
    /// First command that uses it.
    pub first_use: u32,
    /// Last command that uses it.
    pub last_use: u32,
}

impl Plan {
    /// Returns the bytes of each arena block.
    pub fn block_bytes(&self) -> &[u64] {
        &self.blocks
    }

    /// Returns the bytes of the arena.
    pub fn arena_bytes(&self) -> u64 {
        self.blocks.iter().sum()
    }

    /// Fills scratch tensors before their first use with NaN, an index out of range, to expose
    /// uninitialized reads, often zero on CPUs.
    pub(crate) fn poison(&mut self) {
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

    pub(crate) fn stage(&self, command: usize) -> &str {
        let scope = &self.scopes[self.commands[command].scope as usize];
        scope.split('/').next().unwrap_or_default()
    }

    /// Returns the number of commands.
    pub fn len(&self) -> usize {
        self.commands.len()
    }

    /// Returns true if there are no commands.
    pub fn is_empty(&self) -> bool {
        self.commands.is_empty()
    }

    /// Returns the FLOPs of all commands.
    pub fn flops(&self) -> u64 {
        self.commands.iter().map(|c| c.flops).sum()
    }

    /// Returns the arena map in order of first use.
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
