//! Reads the pickles that `torch.save` writes, without executing anything.
//!
//! A pickle is a program for a stack machine (Python's `pickletools` documents it). Here its objects go into one list
//! and refer to each other by index, so that sharing, cycles and depth cost nothing; each opcode makes at most one
//! object, and their number is limited. Calls can only rebuild tensors, dictionaries and plain data such as numpy's
//! scalars, of which nothing is kept: any other name is refused.

mod machine;

use machine::Machine;

/// Index of an object.
pub(super) type Id = usize;

/// An object of a pickle.
#[derive(Debug)]
pub(super) enum Object<'a> {
    /// None, a boolean, a float, bytes, an integer beyond 64 bits, or what a call of [`Callable::PlainData`] gives:
    /// nothing that is read needs them.
    Other,
    Int(i64),
    Text(&'a str),
    /// A list or a tuple.
    Sequence(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Callable(Callable),
    StorageType(&'a str),
    /// Boxed, as the next: most objects of a pickle are small.
    Storage(Box<Storage<'a>>),
    Tensor(Box<Tensor<'a>>),
}

/// The only callables of `REDUCE`.
#[derive(Debug, Clone, Copy)]
pub(super) enum Callable {
    OrderedDict,
    DefaultDict,
    RebuildTensor,
    RebuildParameter,
    /// A number, a set, a path: training leaves them beside the weights, and nothing here needs their value.
    PlainData,
}

/// Values in an archive that tensors share: `kind` is the class in `torch`, `key` the name of the entry.
#[derive(Debug, Clone, Copy)]
pub(super) struct Storage<'a> {
    pub kind: &'a str,
    pub key: &'a str,
    pub elements: usize,
}

/// A view into a storage; offset and strides count elements.
#[derive(Debug)]
pub(super) struct Tensor<'a> {
    pub storage: Storage<'a>,
    pub offset: usize,
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
}

/// Why a pickle cannot be read, and the byte of the opcode.
#[derive(Debug)]
pub(super) struct Malformed {
    pub offset: usize,
    pub reason: String,
}

/// The objects of a pickle.
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

    /// Keys and values of a dictionary, if that is what `id` is.
    pub fn entries(&self, id: Id) -> Option<&[(Id, Id)]> {
        match self.object(id) {
            Object::Dict(entries) => Some(entries),
            _ => None,
        }
    }

    /// The value of `key` in a dictionary.
    pub fn get(&self, dict: Id, key: &str) -> Option<Id> {
        let is_key = |id: Id| matches!(self.object(id), Object::Text(text) if *text == key);
        // Where a key was set twice, Python keeps the later value.
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
