use std::collections::HashMap;

use super::{Callable, Id, Object, Storage, Tensor, size, sizes, text};
use crate::weights::tensor::MAX_RANK;

/// Limit on stored items, six times the largest training checkpoint; bounds memory per input byte.
const MAX_HELD: usize = 1 << 20;

pub(super) struct Machine<'a> {
    bytes: &'a [u8],
    pub at: usize,
    /// The first is [`Object::Other`].
    pub objects: Vec<Object<'a>>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: HashMap<u64, Id>,
    references: usize,
}

impl<'a> Machine<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        let (stack, marks, memo) = Default::default();
        Self { bytes, at: 0, objects: vec![Object::Other], stack, marks, memo, references: 0 }
    }

    pub fn step(&mut self) -> Result<Option<Id>, String> {
        let root = self.run()?;
        let objects = self.objects.len() + self.references + self.stack.len() + self.marks.len() + self.memo.len();
        if objects > MAX_HELD { Err(format!("the pickle makes more than {MAX_HELD} objects")) } else { Ok(root) }
    }

    fn run(&mut self) -> Result<Option<Id>, String> {
        let opcode = self.number(1)? as u8;
        match opcode {
            b'.' => return self.pop().map(Some),                           // STOP
            0x80 => drop(self.number(1)?),                                 // PROTO
            0x95 => drop(self.number(8)?),                                 // FRAME
            b'N' | 0x88 | 0x89 => self.push_other(),                       // NONE, NEW*
            b'G' => self.skip(8)?,                                         // BINFLOAT
            b'K' => self.integer(1)?,                                      // BININT1
            b'M' => self.integer(2)?,                                      // BININT2
            b'J' => self.integer(4)?,                                      // BININT
            0x8a => self.long()?,                                          // LONG1
            b'C' => self.bytes(1)?,                                        // SHORT_BINBYTES
            b'B' => self.bytes(4)?,                                        // BINBYTES
            0x8e => self.bytes(8)?,                                        // BINBYTES8
            b'X' => self.unicode(4)?,                                      // BINUNICODE
            0x8c => self.unicode(1)?,                                      // SHORT_BINUNICODE
            0x8d => self.unicode(8)?,                                      // BINUNICODE8
            b'}' => self.push(Object::Dict(Vec::new())),                   // EMPTY_DICT
            b']' | b')' => self.push(Object::Sequence(Vec::new())),        // EMPTY_*
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

    fn push_other(&mut self) {
        self.stack.push(0);
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
        self.push_other();
        Ok(())
    }

    fn bytes(&mut self, length_bytes: u64) -> Result<(), String> {
        let length = self.number(length_bytes)?;
        self.skip(length)
    }

    /// BININT is signed, shorter integers are not.
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
        self.references += items.len();
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
        self.references += items.len();
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
        self.references += items.len();
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
            _ if is_plain_data(module, name) => Object::Callable(Callable::PlainData),
            ("collections", "OrderedDict") => Object::Callable(Callable::OrderedDict),
            ("collections", "defaultdict") => Object::Callable(Callable::DefaultDict),
            ("torch._utils", "_rebuild_tensor_v2") => Object::Callable(Callable::RebuildTensor),
            ("torch._utils", "_rebuild_parameter") => Object::Callable(Callable::RebuildParameter),
            ("torch", name) if name.ends_with("Storage") => Object::StorageType(name),
            _ => return Err(refusal(module, name)),
        });
        Ok(())
    }

    /// ("storage", type, key, device, element count).
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
        self.push(Object::Storage(Box::new(storage)));
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
            (Callable::OrderedDict, []) | (Callable::DefaultDict, [] | [_]) => self.push(Object::Dict(Vec::new())),
            (Callable::PlainData, _) => self.push_other(),
            (Callable::RebuildParameter, &[tensor, ..]) => self.stack.push(tensor),
            // The remaining arguments do not matter.
            (Callable::RebuildTensor, &[storage, offset, shape, strides, ..]) => {
                let objects = &self.objects;
                let Object::Storage(storage) = &objects[storage] else {
                    return Err("the pickle rebuilds a tensor from what is no storage".into());
                };
                let numbers =
                    size(objects, offset).zip(sizes(objects, shape, MAX_RANK)).zip(sizes(objects, strides, MAX_RANK));
                let ((offset, shape), strides) =
                    numbers.ok_or("the pickle rebuilds a tensor with an offset, shape or stride that is no size")?;
                let storage = **storage;
                self.push(Object::Tensor(Box::new(Tensor { storage, offset, shape, strides })));
            }
            (callable, arguments) => {
                return Err(format!("the pickle calls {callable:?} with {} arguments", arguments.len()));
            }
        }
        Ok(())
    }

    /// Attributes are ignored: `_metadata`, numpy byte order.
    fn build(&mut self) -> Result<(), String> {
        self.pop()?;
        match self.objects[self.top()?] {
            Object::Dict(_) | Object::Other => Ok(()),
            _ => Err("the pickle sets attributes of what is no dictionary".into()),
        }
    }
}

fn is_plain_data(module: &str, name: &str) -> bool {
    const BUILTINS: [&str; 10] =
        ["bool", "bytearray", "bytes", "complex", "dict", "float", "frozenset", "int", "list", "set"];
    const TORCH: [&str; 12] = [
        "Size", "bfloat16", "bool", "device", "float16", "float32", "float64", "int16", "int32", "int64", "int8",
        "uint8",
    ];
    match module {
        "builtins" | "__builtin__" => BUILTINS.contains(&name),
        "torch" => TORCH.contains(&name),
        "collections" => name == "Counter",
        "_codecs" => name == "encode",
        "numpy" => matches!(name, "dtype" | "ndarray"),
        "numpy.core.multiarray" | "numpy._core.multiarray" => matches!(name, "scalar" | "_reconstruct"),
        "pathlib" => matches!(name, "PosixPath" | "WindowsPath" | "PurePosixPath" | "PureWindowsPath"),
        _ => false,
    }
}

fn refusal(module: &str, name: &str) -> String {
    let (module, name) = (module.escape_debug(), name.escape_debug());
    format!("the pickle asks for {module}.{name}; only tensors and plain data are read, nothing is executed")
}
