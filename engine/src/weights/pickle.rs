//! Reads the pickles that `torch.save` writes, without executing anything.
//!
//! A pickle is a program for a stack machine (Python's `pickletools` documents it). Here its objects go into one list
//! and refer to each other by index, so that sharing, cycles and depth cost nothing; each opcode makes at most one
//! object. Calls can only rebuild tensors and ordered dictionaries: any other name is refused.

use std::collections::HashMap;

/// Axes of a tensor at most: PyTorch allows more, weights have four.
const MAX_RANK: usize = 8;

/// Index of an object.
pub(super) type Id = usize;

/// What a pickle's objects can be.
#[derive(Debug)]
pub(super) enum Object<'a> {
    /// None, a boolean, a float or an integer beyond 64 bits: nothing that is read needs them.
    Other,
    Int(i64),
    Text(&'a str),
    /// A list or a tuple.
    Sequence(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Callable(Callable),
    StorageType(&'a str),
    Storage(Storage<'a>),
    Tensor(Tensor<'a>),
}

/// The only callables of `REDUCE`.
#[derive(Debug, Clone, Copy)]
pub(super) enum Callable {
    OrderedDict,
    RebuildTensor,
    RebuildParameter,
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
        let mut machine =
            Machine { bytes, at: 0, objects: Vec::new(), stack: Vec::new(), marks: Vec::new(), memo: HashMap::new() };
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

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    objects: Vec<Object<'a>>,
    stack: Vec<Id>,
    /// Heights of the stack where marks stand.
    marks: Vec<usize>,
    memo: HashMap<u64, Id>,
}

impl<'a> Machine<'a> {
    /// Runs one opcode; the root object once the pickle ends.
    fn step(&mut self) -> Result<Option<Id>, String> {
        let opcode = self.number(1)? as u8;
        match opcode {
            b'.' => return self.pop().map(Some),                           // STOP
            0x80 => drop(self.number(1)?),                                 // PROTO
            0x95 => drop(self.number(8)?),                                 // FRAME
            b'N' | 0x88 | 0x89 => self.push(Object::Other),                // NONE, NEWTRUE, NEWFALSE
            b'G' => self.skip(8)?,                                         // BINFLOAT
            b'K' => self.integer(1)?,                                      // BININT1
            b'M' => self.integer(2)?,                                      // BININT2
            b'J' => self.integer(4)?,                                      // BININT
            0x8a => self.long()?,                                          // LONG1
            b'X' => self.unicode(4)?,                                      // BINUNICODE
            0x8c => self.unicode(1)?,                                      // SHORT_BINUNICODE
            0x8d => self.unicode(8)?,                                      // BINUNICODE8
            b'}' => self.push(Object::Dict(Vec::new())),                   // EMPTY_DICT
            b']' | b')' => self.push(Object::Sequence(Vec::new())),        // EMPTY_LIST, EMPTY_TUPLE
            b'(' => self.marks.push(self.stack.len()),                     // MARK
            b't' => self.pop_mark().map(|items| self.sequence(items))?,    // TUPLE
            0x85..=0x87 => self.tuple(usize::from(opcode - 0x84))?,        // TUPLE1, TUPLE2, TUPLE3
            b'a' => self.pop().and_then(|item| self.append(vec![item]))?,  // APPEND
            b'e' => self.pop_mark().and_then(|items| self.append(items))?, // APPENDS
            b's' => self.set_item()?,                                      // SETITEM
            b'u' => self.pop_mark().and_then(|items| self.set(items))?,    // SETITEMS
            b'q' => self.number(1).and_then(|slot| self.put(slot))?,       // BINPUT
            b'r' => self.number(4).and_then(|slot| self.put(slot))?,       // LONG_BINPUT
            0x94 => self.put(self.memo.len() as u64)?,                     // MEMOIZE
            b'h' => self.number(1).and_then(|slot| self.fetch(slot))?,     // BINGET
            b'j' => self.number(4).and_then(|slot| self.fetch(slot))?,     // LONG_BINGET
            b'c' => self.global()?,                                        // GLOBAL
            0x93 => self.stack_global()?,                                  // STACK_GLOBAL
            b'i' => return Err(refusal(self.line()?, self.line()?)),       // INST
            b'Q' => self.persistent()?,                                    // BINPERSID
            b'R' => self.reduce()?,                                        // REDUCE
            b'b' => self.build()?,                                         // BUILD
            _ => return Err(format!("pickle opcode {opcode:#04x} is not one that torch.save writes for tensors")),
        }
        Ok(None)
    }

    fn take(&mut self, count: u64) -> Result<&'a [u8], String> {
        let rest = &self.bytes[self.at..];
        let taken = usize::try_from(count).ok().and_then(|count| rest.get(..count));
        let taken = taken.ok_or_else(|| format!("the pickle ends {} bytes on, {count} are needed", rest.len()))?;
        self.at += taken.len();
        Ok(taken)
    }

    /// An unsigned little-endian number of up to 8 bytes.
    fn number(&mut self, bytes: u64) -> Result<u64, String> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte)))
    }

    fn line(&mut self) -> Result<&'a str, String> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&byte| byte == b'\n').ok_or("the pickle ends within a name")?;
        self.at += end + 1;
        std::str::from_utf8(&rest[..end]).map_err(|error| format!("name: {error}"))
    }

    fn push(&mut self, object: Object<'a>) {
        self.stack.push(self.objects.len());
        self.objects.push(object);
    }

    fn pop(&mut self) -> Result<Id, String> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let above = self.stack.len() > floor;
        above.then(|| self.stack.pop()).flatten().ok_or_else(|| "the pickle's stack is empty".to_string())
    }

    fn pop_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("the pickle's stack has no mark")?;
        Ok(self.stack.split_off(mark))
    }

    fn top(&self) -> Result<Id, String> {
        let floor = self.marks.last().copied().unwrap_or(0);
        self.stack[floor..].last().copied().ok_or_else(|| "the pickle's stack is empty".to_string())
    }

    fn skip(&mut self, bytes: u64) -> Result<(), String> {
        self.take(bytes)?;
        self.push(Object::Other);
        Ok(())
    }

    /// BININT is signed, the shorter ones are not.
    fn integer(&mut self, bytes: u64) -> Result<(), String> {
        let value = self.number(bytes)?;
        self.push(Object::Int(if bytes == 4 { i64::from(value as u32 as i32) } else { value as i64 }));
        Ok(())
    }

    fn long(&mut self) -> Result<(), String> {
        let bytes = self.number(1)?;
        if bytes > 8 {
            return self.skip(bytes);
        }
        let value = self.number(bytes)? as i64;
        let unused = 64 - 8 * bytes as u32;
        self.push(Object::Int(if bytes == 0 { 0 } else { value << unused >> unused }));
        Ok(())
    }

    fn unicode(&mut self, length_bytes: u64) -> Result<(), String> {
        let length = self.number(length_bytes)?;
        let text = std::str::from_utf8(self.take(length)?).map_err(|error| format!("text: {error}"))?;
        self.push(Object::Text(text));
        Ok(())
    }

    fn sequence(&mut self, items: Vec<Id>) {
        self.push(Object::Sequence(items));
    }

    fn tuple(&mut self, length: usize) -> Result<(), String> {
        let mut items = (0..length).map(|_| self.pop()).collect::<Result<Vec<Id>, String>>()?;
        items.reverse();
        self.sequence(items);
        Ok(())
    }

    fn append(&mut self, items: Vec<Id>) -> Result<(), String> {
        let top = self.top()?;
        match &mut self.objects[top] {
            Object::Sequence(list) => list.extend(items),
            _ => return Err("the pickle appends to what is no list".into()),
        }
        Ok(())
    }

    fn set_item(&mut self) -> Result<(), String> {
        let (value, key) = (self.pop()?, self.pop()?);
        self.set(vec![key, value])
    }

    fn set(&mut self, items: Vec<Id>) -> Result<(), String> {
        let top = self.top()?;
        let (pairs, odd) = items.as_chunks::<2>();
        match &mut self.objects[top] {
            Object::Dict(dict) if odd.is_empty() => dict.extend(pairs.iter().map(|&[key, value]| (key, value))),
            _ => return Err("the pickle sets items of what is no dictionary".into()),
        }
        Ok(())
    }

    fn put(&mut self, slot: u64) -> Result<(), String> {
        let top = self.top()?;
        self.memo.insert(slot, top);
        Ok(())
    }

    fn fetch(&mut self, slot: u64) -> Result<(), String> {
        let id = self.memo.get(&slot).ok_or_else(|| format!("the pickle's memo has no entry {slot}"))?;
        self.stack.push(*id);
        Ok(())
    }

    fn global(&mut self) -> Result<(), String> {
        let (module, name) = (self.line()?, self.line()?);
        self.name(module, name)
    }

    fn stack_global(&mut self) -> Result<(), String> {
        let (name, module) = (self.pop()?, self.pop()?);
        match (text(&self.objects, module), text(&self.objects, name)) {
            (Some(module), Some(name)) => self.name(module, name),
            _ => Err("the pickle names a callable by what is no text".into()),
        }
    }

    fn name(&mut self, module: &'a str, name: &'a str) -> Result<(), String> {
        self.push(match (module, name) {
            ("collections", "OrderedDict") => Object::Callable(Callable::OrderedDict),
            ("torch._utils", "_rebuild_tensor_v2") => Object::Callable(Callable::RebuildTensor),
            ("torch._utils", "_rebuild_parameter") => Object::Callable(Callable::RebuildParameter),
            ("torch", name) if name.ends_with("Storage") => Object::StorageType(name),
            _ => return Err(refusal(module, name)),
        });
        Ok(())
    }

    /// Persistent objects are storages: ("storage", type, key, device, number of elements).
    fn persistent(&mut self) -> Result<(), String> {
        let id = self.pop()?;
        let storage = || {
            let Object::Sequence(items) = &self.objects[id] else { return None };
            let &[tag, kind, key, _, elements] = items.as_slice() else { return None };
            let Object::StorageType(kind) = self.objects[kind] else { return None };
            let (key, elements) = (text(&self.objects, key)?, size(&self.objects, elements)?);
            (text(&self.objects, tag)? == "storage").then_some(Storage { kind, key, elements })
        };
        let storage = storage().ok_or("a persistent object of the pickle is no storage")?;
        self.push(Object::Storage(storage));
        Ok(())
    }

    fn reduce(&mut self) -> Result<(), String> {
        let (arguments, callable) = (self.pop()?, self.pop()?);
        let Object::Callable(callable) = self.objects[callable] else {
            return Err("the pickle calls what cannot be called".into());
        };
        let Object::Sequence(arguments) = &self.objects[arguments] else {
            return Err("the pickle calls without a tuple of arguments".into());
        };
        match (callable, arguments.as_slice()) {
            (Callable::OrderedDict, []) => self.push(Object::Dict(Vec::new())),
            (Callable::RebuildParameter, &[tensor, ..]) => self.stack.push(tensor),
            // After these come requires_grad and hooks, which inference does not need.
            (Callable::RebuildTensor, &[storage, offset, shape, strides, ..]) => {
                let objects = &self.objects;
                let Object::Storage(storage) = objects[storage] else {
                    return Err("the pickle rebuilds a tensor from what is no storage".into());
                };
                let numbers =
                    size(objects, offset).zip(sizes(objects, shape, MAX_RANK)).zip(sizes(objects, strides, MAX_RANK));
                let ((offset, shape), strides) =
                    numbers.ok_or("the pickle rebuilds a tensor with an offset, shape or stride that is no size")?;
                self.push(Object::Tensor(Tensor { storage, offset, shape, strides }));
            }
            (callable, arguments) => {
                return Err(format!("the pickle calls {callable:?} with {} arguments", arguments.len()));
            }
        }
        Ok(())
    }

    /// Attributes: a `state_dict` carries `_metadata`, which holds no weights.
    fn build(&mut self) -> Result<(), String> {
        self.pop()?;
        match self.objects[self.top()?] {
            Object::Dict(_) => Ok(()),
            _ => Err("the pickle sets attributes of what is no dictionary".into()),
        }
    }
}

fn refusal(module: &str, name: &str) -> String {
    let (module, name) = (module.escape_debug(), name.escape_debug());
    format!("the pickle asks for {module}.{name}; only tensors and plain data are read, nothing is executed")
}
