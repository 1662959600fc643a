//! Kernel interfaces, parsed from SPIR-V (unified specification 1.6, sections 2.3 and 3.x).

use std::collections::{BTreeMap, HashMap};

pub struct Interface {
    pub buffers: Vec<Buffer>,
    pub push: Vec<Member>,
    pub constants: Vec<(u32, String, Scalar)>,
    /// Workgroup size; `None` if ID 0 sets it to whole subgroups.
    pub local_size: Option<[u32; 3]>,
    pub capabilities: Vec<u32>,
}

pub struct Buffer {
    pub name: String,
    pub binding: u32,
    pub reads: bool,
    pub writes: bool,
}

pub struct Member {
    pub name: String,
    pub offset: u32,
    pub scalar: Scalar,
    pub count: u32,
}

#[derive(Clone, Copy, PartialEq)]
pub enum Scalar {
    Bool,
    U32,
    I32,
    F32,
}

#[derive(Clone)]
enum Type {
    Scalar(Scalar),
    Vector(u32, u32),
    Struct(Vec<u32>),
    Pointer(u32),
    Other,
}

pub const STORAGE_BUFFER_16_BIT: u32 = 4433;
pub const DOT_PRODUCT_PACKED: u32 = 6018;
pub const COOPERATIVE_MATRIX: u32 = 6022;
pub const COOPERATIVE_MATRIX_CONVERSIONS: u32 = 5431;

impl Interface {
    pub fn has(&self, capability: u32) -> bool {
        self.capabilities.contains(&capability)
    }
}

const SPEC_ID: u32 = 1;
const NON_WRITABLE: u32 = 24;
const NON_READABLE: u32 = 25;
const BINDING: u32 = 33;
const OFFSET: u32 = 35;
const PUSH_CONSTANT: u32 = 9;
const STORAGE_BUFFER: u32 = 12;

#[derive(Default)]
struct Tables {
    names: HashMap<u32, String>,
    member_names: HashMap<(u32, u32), String>,
    decorations: HashMap<(u32, u32), u32>,
    member_decorations: HashMap<(u32, u32, u32), u32>,
    types: HashMap<u32, Type>,
    constants: BTreeMap<u32, u32>,
    variables: Vec<(u32, u32, u32)>,
    local_size: Option<[u32; 3]>,
    capabilities: Vec<u32>,
}

pub fn reflect(name: &str, bytes: &[u8]) -> Interface {
    let words: Vec<u32> = bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    assert!(words.first() == Some(&0x0723_0203), "kernels/spirv/{name}.spv is not SPIR-V");
    let tables = scan(&words);
    let mut buffers = Vec::new();
    let mut push = Vec::new();
    for &(variable, pointer, storage) in &tables.variables {
        let Some(Type::Pointer(target)) = tables.types.get(&pointer) else { continue };
        let Some(Type::Struct(members)) = tables.types.get(target) else { continue };
        match storage {
            STORAGE_BUFFER => {
                let all = |d| {
                    tables.decorations.contains_key(&(variable, d))
                        || (0..members.len() as u32).all(|m| tables.member_decorations.contains_key(&(*target, m, d)))
                };
                buffers.push(Buffer {
                    name: snake_case(&tables.names[target]),
                    binding: tables.decorations[&(variable, BINDING)],
                    reads: !all(NON_READABLE),
                    writes: !all(NON_WRITABLE),
                });
            }
            PUSH_CONSTANT => push.extend(members.iter().enumerate().map(|(m, ty)| {
                let (scalar, count) = shape(&tables, *ty, name);
                let key = (*target, m as u32);
                Member {
                    name: tables.member_names[&key].clone(),
                    offset: tables.member_decorations[&(key.0, key.1, OFFSET)],
                    scalar,
                    count,
                }
            })),
            _ => {}
        }
    }
    buffers.sort_by_key(|b| b.binding);
    let mut constants: Vec<_> = tables
        .constants
        .iter()
        .filter_map(|(id, ty)| {
            let spec = *tables.decorations.get(&(*id, SPEC_ID))?;
            Some((spec, tables.names.get(id).cloned().unwrap_or_default().to_lowercase(), shape(&tables, *ty, name).0))
        })
        .collect();
    constants.sort_by_key(|c| c.0);
    let whole_subgroups = constants.first().is_some_and(|c| c.0 == 0);
    constants.retain(|c| c.0 != 0);
    let local_size = if whole_subgroups { None } else { tables.local_size };
    Interface { buffers, push, constants, local_size, capabilities: tables.capabilities }
}

fn scan(words: &[u32]) -> Tables {
    let mut t = Tables::default();
    let mut at = 5;
    while at < words.len() {
        let (length, opcode) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        let op = &words[at + 1..at + length];
        match opcode {
            5 => drop(t.names.insert(op[0], text(&op[1..]))),
            6 => drop(t.member_names.insert((op[0], op[1]), text(&op[2..]))),
            17 => t.capabilities.push(op[0]),
            16 if op[1] == 17 => t.local_size = Some([op[2], op[3], op[4]]),
            20 => drop(t.types.insert(op[0], Type::Scalar(Scalar::Bool))),
            21 => drop(t.types.insert(
                op[0],
                match (op[1], op[2]) {
                    (32, 0) => Type::Scalar(Scalar::U32),
                    (32, _) => Type::Scalar(Scalar::I32),
                    _ => Type::Other,
                },
            )),
            22 => drop(t.types.insert(op[0], if op[1] == 32 { Type::Scalar(Scalar::F32) } else { Type::Other })),
            23 => drop(t.types.insert(op[0], Type::Vector(op[1], op[2]))),
            30 => drop(t.types.insert(op[0], Type::Struct(op[1..].to_vec()))),
            32 => drop(t.types.insert(op[0], Type::Pointer(op[2]))),
            48..=50 => drop(t.constants.insert(op[1], op[0])),
            59 => t.variables.push((op[1], op[0], op[2])),
            71 => drop(t.decorations.insert((op[0], op[1]), op.get(2).copied().unwrap_or(0))),
            72 => drop(t.member_decorations.insert((op[0], op[1], op[2]), op.get(3).copied().unwrap_or(0))),
            _ => {}
        }
        at += length;
    }
    t
}

fn shape(tables: &Tables, ty: u32, kernel: &str) -> (Scalar, u32) {
    match tables.types.get(&ty) {
        Some(Type::Scalar(s)) => (*s, 1),
        Some(Type::Vector(element, count)) => (shape(tables, *element, kernel).0, *count),
        _ => panic!("kernels/{kernel}.comp: push and specialization constants are 32-bit scalars or vectors"),
    }
}

fn text(words: &[u32]) -> String {
    let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).take_while(|b| *b != 0).collect();
    String::from_utf8(bytes).expect("SPIR-V names are UTF-8")
}

fn snake_case(name: &str) -> String {
    let mut out = String::new();
    for c in name.chars() {
        if c.is_ascii_uppercase() && !out.is_empty() {
            out.push('_');
        }
        out.push(c.to_ascii_lowercase());
    }
    out
}
