//! Objects are indices in a bounded list: sharing, cycles and depth are harmless. Calls build
//! tensors, dictionaries and plain data only.

mod machine;

use machine::Machine;

pub(super) type Id = usize;

#[derive(Debug)]
pub(super) enum Object<'a> {
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

#[derive(Debug, Clone, Copy)]
pub(super) enum Callable {
    OrderedDict,
    DefaultDict,
    RebuildTensor,
    RebuildParameter,
    PlainData,
}

/// `kind` is the `torch` class, `key` the archive entry.
#[derive(Debug, Clone, Copy)]
pub(super) struct Storage<'a> {
    pub kind: &'a str,
    pub key: &'a str,
    pub elements: usize,
}

/// Offset and strides count elements.
#[derive(Debug)]
pub(super) struct Tensor<'a> {
    pub storage: Storage<'a>,
    pub offset: usize,
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
}

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

    pub fn entries(&self, id: Id) -> Option<&[(Id, Id)]> {
        match self.object(id) {
            Object::Dict(entries) => Some(entries),
            _ => None,
        }
    }

    pub fn get(&self, dict: Id, key: &str) -> Option<Id> {
        let is_key = |id: Id| matches!(self.object(id), Object::Text(text) if *text == key);
        // Python keeps the last duplicate.
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
