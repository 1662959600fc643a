//! Reads `torch.save` pickles without executing code.
//!
//! A pickle is a program for a stack machine (see Python's `pickletools`). Objects are stored in
//! one bounded list and refer to each other by index, so sharing, cycles and depth are harmless.
//! Calls only rebuild tensors, dictionaries and plain data; other names are rejected.

mod machine;

use machine::Machine;

pub(super) type Id = usize;

/// Pickle object.
#[derive(Debug)]
pub(super) enum Object<'a> {
    /// Ignored values: None, booleans, floats, bytes, integers beyond 64 bits, plain data.
    Other,
    Int(i64),
    Text(&'a str),
    Sequence(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Callable(Callable),
    StorageType(&'a str),
    /// Boxed to keep objects small.
    Storage(Box<Storage<'a>>),
    Tensor(Box<Tensor<'a>>),
}

/// Allowed callables of `REDUCE`.
#[derive(Debug, Clone, Copy)]
pub(super) enum Callable {
    OrderedDict,
    DefaultDict,
    RebuildTensor,
    RebuildParameter,
    /// Numbers, sets, paths and the like, whose values are ignored.
    PlainData,
}

/// Tensor storage: `kind` is the `torch` class, `key` the archive entry.
#[derive(Debug, Clone, Copy)]
pub(super) struct Storage<'a> {
    pub kind: &'a str,
    pub key: &'a str,
    pub elements: usize,
}

/// View into a storage; offset and strides count elements.
#[derive(Debug)]
pub(super) struct Tensor<'a> {
    pub storage: Storage<'a>,
    pub offset: usize,
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
}

/// Reason for failure, and the opcode's byte offset.
#[derive(Debug)]
pub(super) struct Malformed {
    pub offset: usize,
    pub reason: String,
}

pub(super) struct Pickle<'a> {
    objects: Vec<Object<'a>>,
    pub root: Id,
}

impl<'a> Pickle<'a> {
    pub fn load(bytes: &'a [u8]) -> Result<Self, Malformed> {
        let mut machine = Machine::new(bytes);
        loop {
            let offset = machine.at;
            match machine.step() {
                Ok(None) => {}
                Ok(Some(root)) => return Ok(Self { objects: machine.objects, root }),
                Err(reason) => return Err(Malformed { offset, reason }),
            }
        }
    }

    pub fn object(&self, id: Id) -> &Object<'a> {
        &self.objects[id]
    }

    /// Entries, if `id` is a dictionary.
    pub fn entries(&self, id: Id) -> Option<&[(Id, Id)]> {
        match self.object(id) {
            Object::Dict(entries) => Some(entries),
            _ => None,
        }
    }

    pub fn get(&self, dict: Id, key: &str) -> Option<Id> {
        let is_key = |id: Id| matches!(self.object(id), Object::Text(text) if *text == key);
        // Python keeps the last of duplicate keys.
        self.entries(dict)?.iter().rev().find(|&&(id, _)| is_key(id)).map(|&(_, value)| value)
    }

    pub fn text(&self, id: Id) -> Option<&'a str> {
        text(&self.objects, id)
    }

    pub fn size(&self, id: Id) -> Option<usize> {
        size(&self.objects, id)
    }

    pub fn int(&self, id: Id) -> Option<i64> {
        match self.object(id) {
            Object::Int(value) => Some(*value),
            _ => None,
        }
    }

    /// A list or tuple of at most `max` sizes.
    pub fn sizes(&self, id: Id, max: usize) -> Option<Vec<usize>> {
        sizes(&self.objects, id, max)
    }
}

fn text<'a>(objects: &[Object<'a>], id: Id) -> Option<&'a str> {
    match objects[id] {
        Object::Text(text) => Some(text),
        _ => None,
    }
}

fn size(objects: &[Object], id: Id) -> Option<usize> {
    match objects[id] {
        Object::Int(value) => value.try_into().ok(),
        _ => None,
    }
}

fn sizes(objects: &[Object], id: Id, max: usize) -> Option<Vec<usize>> {
    match &objects[id] {
        Object::Sequence(items) if items.len() <= max => items.iter().map(|&item| size(objects, item)).collect(),
        _ => None,
    }
}
