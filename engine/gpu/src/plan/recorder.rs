use super::{
    Allocation, Command, Dispatch, Operation, Role,
    layout::{self, Lifetime},
};
use crate::{Element, Error, Kernel, Limits, Needs, Plan, Result, Tensor, memory::tensor::Home};

/// Row length of folded dispatches; devices may limit each axis to 65,535 groups.
pub const GROUP_FOLD: u32 = 32_768;

/// Records a plan from a device's limits, without a device.
pub struct Recorder {
    limits: Limits,
    commands: Vec<Command>,
    scopes: Vec<String>,
    scope: u32,
    allocations: Vec<Allocation>,
    observed: Option<Vec<(String, Tensor)>>,
    error: Option<Error>,
}

impl Recorder {
    /// Creates an empty recorder.
    pub fn new(limits: &Limits) -> Self {
        Self {
            limits: limits.clone(),
            commands: Vec::new(),
            scopes: vec![String::new()],
            scope: 0,
            allocations: Vec::new(),
            observed: None,
            error: None,
        }
    }

    /// Returns the device limits.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Adds a scratch tensor of `len` elements, alive from first to last use.
    pub fn tensor<T>(&mut self, name: &str, len: usize) -> Tensor {
        self.allocate::<T>(name, len, Role::Scratch)
    }

    /// As [`Recorder::tensor`], with a runtime element type.
    pub fn tensor_of(&mut self, element: Element, name: &str, len: usize) -> Tensor {
        self.tensor::<u8>(name, len.saturating_mul(element.bytes()))
    }

    /// Adds a tensor that the host writes before every run; later tensors may reuse its bytes.
    pub fn input<T>(&mut self, name: &str, len: usize) -> Tensor {
        self.allocate::<T>(name, len, Role::Input)
    }

    /// Adds a tensor that the host writes once, kept between runs.
    pub fn constant<T>(&mut self, name: &str, len: usize) -> Tensor {
        self.allocate::<T>(name, len, Role::Constant)
    }

    /// Keeps a tensor until the end, for the host.
    pub fn output(&mut self, tensor: Tensor) {
        if let Home::Arena(id) = tensor.home {
            self.allocations[id as usize].output = true;
        }
        self.keep(tensor);
    }

    /// Keeps a tensor until the end, for [`Run::present`](crate::Run::present).
    pub fn keep(&mut self, tensor: Tensor) {
        if let Home::Arena(id) = tensor.home {
            self.allocations[id as usize].kept = true;
        }
    }

    /// Enables [`Recorder::observe`].
    pub fn observing(mut self) -> Self {
        self.observed = Some(Vec::new());
        self
    }

    /// Copies a tensor as of this point for [`crate::Run::observed`], if [`Recorder::observing`].
    pub fn observe(&mut self, name: &str, tensor: Tensor) {
        if self.observed.is_some() {
            let copy = self.tensor::<u8>(name, tensor.bytes as usize);
            self.copy(tensor, copy);
            self.output(copy);
            self.observed.get_or_insert_default().push((name.to_owned(), copy));
        }
    }

    /// Records `body` as scope `name` of profiles. Slashes join nested scopes.
    pub fn scope<R>(&mut self, name: &str, body: impl FnOnce(&mut Self) -> R) -> R {
        let outer = self.scope;
        let parent = &self.scopes[outer as usize];
        let path = if parent.is_empty() { name.to_owned() } else { format!("{parent}/{name}") };
        self.scope = match self.scopes.iter().position(|s| *s == path) {
            Some(known) => known as u32,
            None => {
                self.scopes.push(path);
                self.scopes.len() as u32 - 1
            }
        };
        let result = body(self);
        self.scope = outer;
        result
    }

    /// Dispatches workgroups of at least `threads` invocations.
    pub fn dispatch<K: Kernel>(&mut self, kernel: K, threads: impl Threads) -> Recorded<'_> {
        let size = kernel.module().local_size.xyz(self.limits.subgroup_size, &kernel.constants());
        let (threads, along_x) = threads.counts();
        self.fixed(kernel, [0, 1, 2].map(|i| threads[i].div_ceil(size[i])), along_x)
    }

    /// Dispatches workgroups. A single count above `GROUP_FOLD` is folded into rows, which
    /// `group_index()` unfolds in kernels.
    pub fn dispatch_groups<K: Kernel>(&mut self, kernel: K, groups: impl Threads) -> Recorded<'_> {
        let (groups, along_x) = groups.counts();
        self.fixed(kernel, groups, along_x)
    }

    fn fixed<K: Kernel>(&mut self, kernel: K, mut groups: [u32; 3], along_x: bool) -> Recorded<'_> {
        if along_x && groups[0] > GROUP_FOLD {
            groups = [GROUP_FOLD, groups[0].div_ceil(GROUP_FOLD), 1];
        }
        let module = kernel.module();
        if let Some(axis) = (0..3).find(|&i| groups[i] > self.limits.max_groups[i]) {
            self.fail(Error::argument(
                format!("workgroups of {} along axis {axis}", module.name),
                groups[axis],
                format!("at most {}", self.limits.max_groups[axis]),
            ));
        }
        if groups.contains(&0) {
            return Recorded(None);
        }
        let Needs { half_storage, matrices, conversions, dot_products } = module.needs;
        let can = (!half_storage || self.limits.half_storage)
            && (!dot_products || self.limits.dot_products)
            && (!conversions || self.limits.matrices.conversions)
            && matrices.is_none_or(|factor| self.limits.matrices.of(factor).is_some());
        assert!(can, "{} needs what {} has not: {:?}", module.name, self.limits.name, module.needs);
        let buffers = kernel.buffers();
        for (tensor, binding) in buffers.iter().zip(module.bindings) {
            if tensor.bytes > self.limits.max_binding_bytes {
                self.fail(Error::Memory {
                    what: format!("binding {} of {} at once", binding.name, module.name),
                    needed: tensor.bytes,
                    available: self.limits.max_binding_bytes,
                });
            }
        }
        let (constants, push) = (kernel.constants(), kernel.push());
        self.command(Operation::Dispatch(Dispatch { module, constants, push, buffers, groups }));
        Recorded(self.commands.last_mut())
    }

    /// Fills a tensor with a 32-bit word.
    pub fn fill(&mut self, target: Tensor, value: u32) {
        if target.bytes > 0 {
            self.command(Operation::Fill { target, value });
        }
    }

    /// Copies between tensors of equal length.
    pub fn copy(&mut self, source: Tensor, target: Tensor) {
        assert_eq!(source.bytes, target.bytes, "copy between tensors of different length");
        if source.bytes > 0 {
            self.command(Operation::Copy { source, target });
        }
    }

    /// Lays out the arena.
    ///
    /// # Errors
    /// A tensor beyond the device's memory or binding limit.
    pub fn finish(mut self) -> Result<Plan> {
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        let lifetimes = self.lifetimes();
        let (placements, blocks) =
            layout::place(&lifetimes, self.limits.max_block_bytes).map_err(|i| Error::Memory {
                what: format!("tensor {}", self.allocations[i].name),
                needed: lifetimes[i].bytes,
                available: self.limits.max_block_bytes,
            })?;
        let Self { commands, scopes, allocations, observed, .. } = self;
        let observed = observed.unwrap_or_default();
        Ok(Plan { commands, scopes, allocations, placements, blocks, observed })
    }

    fn allocate<T>(&mut self, name: &str, len: usize, role: Role) -> Tensor {
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        let scope = &self.scopes[self.scope as usize];
        let name = if scope.is_empty() { name.to_owned() } else { format!("{scope}/{name}") };
        self.allocations.push(Allocation { name, bytes, role, kept: false, output: false });
        Tensor { home: Home::Arena(self.allocations.len() as u32 - 1), offset: 0, bytes }
    }

    fn command(&mut self, operation: Operation) {
        self.commands.push(Command { operation, scope: self.scope, flops: 0 });
    }

    fn fail(&mut self, error: Error) {
        self.error.get_or_insert(error);
    }

    fn lifetimes(&self) -> Vec<Lifetime> {
        let end = self.commands.len() as u32;
        let mut lives: Vec<_> =
            self.allocations.iter().map(|a| Lifetime { bytes: a.bytes, first: end, last: 0 }).collect();
        for (i, command) in self.commands.iter().enumerate() {
            command.operation.for_each_access(|tensor, _, _| {
                if let Home::Arena(id) = tensor.home {
                    let life = &mut lives[id as usize];
                    life.first = life.first.min(i as u32);
                    life.last = life.last.max(i as u32);
                }
            });
        }
        for (life, allocation) in lives.iter_mut().zip(&self.allocations) {
            match allocation.role {
                Role::Constant => (life.first, life.last) = (0, end),
                Role::Input => life.first = 0,
                Role::Scratch => {}
            }
            if allocation.kept {
                life.last = end;
            }
            life.first = life.first.min(life.last);
        }
        lives
    }
}

impl Operation {
    /// Calls `visit(tensor, reads, writes)` for each access.
    pub(crate) fn for_each_access(&self, mut visit: impl FnMut(Tensor, bool, bool)) {
        match self {
            Operation::Dispatch(dispatch) => {
                for (tensor, binding) in dispatch.buffers.iter().zip(dispatch.module.bindings) {
                    visit(*tensor, binding.reads, binding.writes);
                }
            }
            Operation::Fill { target, .. } => visit(*target, false, true),
            Operation::Copy { source, target } => {
                visit(*source, true, false);
                visit(*target, false, true);
            }
        }
    }
}

pub struct Recorded<'a>(Option<&'a mut Command>);

impl Recorded<'_> {
    pub fn flops(self, flops: u64) {
        if let Some(command) = self.0 {
            command.flops = flops;
        }
    }
}

/// Counts along x, y and z; a single number counts along x.
pub trait Threads: Copy {
    /// Returns the counts, and whether they are a single number.
    fn counts(self) -> ([u32; 3], bool);
}

impl Threads for u32 {
    fn counts(self) -> ([u32; 3], bool) {
        ([self, 1, 1], true)
    }
}

impl Threads for usize {
    fn counts(self) -> ([u32; 3], bool) {
        u32::try_from(self).expect("dispatches count in 32 bits").counts()
    }
}

impl Threads for [u32; 3] {
    fn counts(self) -> ([u32; 3], bool) {
        (self, false)
    }
}
