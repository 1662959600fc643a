//! The vertex table of a PLY file (Turk 1994): any scalar properties, binary little endian or ASCII.

use std::borrow::Cow;

use rayon::prelude::*;

/// The header must end within this many bytes.
pub(super) const MAX_HEADER: usize = 1 << 16;

/// What is wrong and where in the file.
pub(super) struct Fault {
    pub offset: usize,
    pub reason: String,
}

type Parsed<T> = Result<T, Fault>;

/// The vertices, a row of `row_bytes` each.
pub(super) struct Table<'a> {
    rows: Cow<'a, [u8]>,
    row_bytes: usize,
    columns: Vec<(String, Column)>,
    /// Where the rows' values begin in the file.
    body: usize,
}

impl<'a> Table<'a> {
    /// The table of a whole file. Counts are compared with the file's length before anything is allocated by them.
    pub(super) fn parse(bytes: &'a [u8]) -> Parsed<Self> {
        let Header { ascii, elements, body } = Header::parse(bytes)?;
        let fault = |reason: String| Fault { offset: body, reason };
        let Some(position) = elements.iter().position(|element| element.name == "vertex") else {
            return Err(fault("the header names no vertex element".into()));
        };
        let (before, vertex) = (&elements[..position], &elements[position]);
        if let Some(element) = elements[..=position].iter().find(|element| element.has_list) {
            return Err(fault(format!("element {} has a list property, expected scalars", element.name)));
        }
        if vertex.properties.is_empty() {
            return Err(fault("the vertex element has no properties".into()));
        }
        let rows = if ascii {
            Cow::Owned(ascii_rows(&bytes[body..], before, vertex).map_err(fault)?)
        } else {
            Cow::Borrowed(binary_rows(&bytes[body..], before, vertex).map_err(fault)?)
        };
        let mut row_bytes = 0;
        let mut columns = Vec::new();
        for (name, scalar) in &vertex.properties {
            let scalar = if ascii { Scalar::F32 } else { *scalar };
            columns.push((name.clone(), Column { offset: row_bytes, scalar }));
            row_bytes += scalar.size();
        }
        Ok(Self { rows, row_bytes, columns, body })
    }

    /// Vertices.
    pub(super) fn len(&self) -> usize {
        self.rows.len() / self.row_bytes
    }

    /// The rows in the file's order.
    pub(super) fn rows(&self) -> rayon::slice::ChunksExact<'_, u8> {
        self.rows.par_chunks_exact(self.row_bytes)
    }

    /// The properties' names in the file's order.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.columns.iter().map(|(name, _)| name.as_str())
    }

    /// The property called `name`.
    pub(super) fn column(&self, name: &str) -> Parsed<Column> {
        let found = self.columns.iter().find(|(column, _)| column == name);
        found.map(|(_, column)| *column).ok_or_else(|| {
            let names: Vec<_> = self.names().collect();
            self.fault(format!("the vertices have no property {name}, only {}", names.join(", ")))
        })
    }

    /// A fault of the table's contents.
    pub(super) fn fault(&self, reason: String) -> Fault {
        Fault { offset: self.body, reason }
    }
}

fn binary_rows<'a>(body: &'a [u8], before: &[Element], vertex: &Element) -> Result<&'a [u8], String> {
    let bytes = |element: &Element| element.count.checked_mul(element.row_bytes());
    let start = before.iter().try_fold(0usize, |sum, element| sum.checked_add(bytes(element)?));
    let range = start.and_then(|start| Some(start..start.checked_add(bytes(vertex)?)?));
    range.and_then(|range| body.get(range)).ok_or_else(|| truncated(body, vertex, "bytes", vertex.row_bytes()))
}

/// The values as rows of little-endian f32.
fn ascii_rows(body: &[u8], before: &[Element], vertex: &Element) -> Result<Vec<u8>, String> {
    let values = |element: &Element| element.count.checked_mul(element.properties.len());
    let skipped = before.iter().try_fold(0usize, |sum, element| sum.checked_add(values(element)?));
    // A value takes a digit and, but for the last, a separator.
    let most = body.len() / 2 + 1;
    let (Some(skipped), Some(count)) = (skipped, values(vertex).filter(|&count| count <= most)) else {
        return Err(truncated(body, vertex, "values", vertex.properties.len()));
    };
    let mut tokens = body.split(u8::is_ascii_whitespace).filter(|token| !token.is_empty()).skip(skipped);
    let mut rows = Vec::with_capacity(4 * count);
    for i in 0..count {
        let (vertex_index, property) = (i / vertex.properties.len(), &vertex.properties[i % vertex.properties.len()].0);
        let Some(token) = tokens.next() else {
            return Err(truncated(body, vertex, "values", vertex.properties.len()));
        };
        let value = std::str::from_utf8(token).ok().and_then(|token| token.parse::<f32>().ok());
        let Some(value) = value else {
            let found = String::from_utf8_lossy(&token[..token.len().min(32)]);
            return Err(format!("vertex {vertex_index}, {property}: found {found:?}, expected a number"));
        };
        rows.extend_from_slice(&value.to_le_bytes());
    }
    Ok(rows)
}

fn truncated(body: &[u8], vertex: &Element, unit: &str, width: usize) -> String {
    format!(
        "truncated: the header promises {} vertices of {width} {unit}, {} bytes follow it",
        vertex.count,
        body.len()
    )
}

struct Header {
    ascii: bool,
    elements: Vec<Element>,
    /// Where the elements' values begin.
    body: usize,
}

#[derive(Default)]
struct Element {
    name: String,
    count: usize,
    properties: Vec<(String, Scalar)>,
    has_list: bool,
}

impl Element {
    fn row_bytes(&self) -> usize {
        self.properties.iter().map(|(_, scalar)| scalar.size()).sum()
    }
}

impl Header {
    fn parse(bytes: &[u8]) -> Parsed<Self> {
        if !bytes.starts_with(b"ply") {
            return Err(Fault { offset: 0, reason: "does not start with \"ply\"".into() });
        }
        let mut ascii = None;
        let mut elements: Vec<Element> = Vec::new();
        let mut offset = 0;
        for line in bytes[..bytes.len().min(MAX_HEADER)].split_inclusive(|&byte| byte == b'\n') {
            let text = String::from_utf8_lossy(line);
            let fault = |reason: &str| Fault { offset, reason: format!("{reason}: {:?}", text.trim()) };
            match text.split_whitespace().collect::<Vec<_>>()[..] {
                ["format", "ascii", _] => ascii = Some(true),
                ["format", "binary_little_endian", _] => ascii = Some(false),
                ["format", ..] => return Err(fault("expected ascii or binary_little_endian")),
                ["element", name, count] => {
                    let count = count.parse().map_err(|_| fault("the count is not a number that can be"))?;
                    elements.push(Element { name: name.into(), count, ..Element::default() });
                }
                ["property", "list", ..] => {
                    elements.last_mut().ok_or_else(|| fault("a property before any element"))?.has_list = true;
                }
                ["property", scalar, name] => {
                    let scalar = Scalar::named(scalar).ok_or_else(|| fault("unknown type"))?;
                    let element = elements.last_mut().ok_or_else(|| fault("a property before any element"))?;
                    element.properties.push((name.into(), scalar));
                }
                ["end_header"] => {
                    let ascii = ascii.ok_or_else(|| fault("no format line before"))?;
                    return Ok(Self { ascii, elements, body: offset + line.len() });
                }
                ["ply"] | ["comment" | "obj_info", ..] | [] => {}
                _ => return Err(fault("not a line of a PLY header")),
            }
            offset += line.len();
        }
        Err(Fault { offset, reason: "the header does not end".into() })
    }
}

/// A PLY's scalar types.
#[derive(Clone, Copy)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// A property's place in a row of the table.
#[derive(Clone, Copy)]
pub(super) struct Column {
    offset: usize,
    scalar: Scalar,
}

impl Column {
    /// The property's value in one row.
    pub(super) fn read(self, row: &[u8]) -> f32 {
        fn at<const N: usize>(row: &[u8], offset: usize) -> [u8; N] {
            *row[offset..].first_chunk().expect("columns lie within the row")
        }
        match self.scalar {
            Scalar::I8 => f32::from(i8::from_le_bytes(at(row, self.offset))),
            Scalar::U8 => f32::from(row[self.offset]),
            Scalar::I16 => f32::from(i16::from_le_bytes(at(row, self.offset))),
            Scalar::U16 => f32::from(u16::from_le_bytes(at(row, self.offset))),
            Scalar::I32 => i32::from_le_bytes(at(row, self.offset)) as f32,
            Scalar::U32 => u32::from_le_bytes(at(row, self.offset)) as f32,
            Scalar::F32 => f32::from_le_bytes(at(row, self.offset)),
            Scalar::F64 => f64::from_le_bytes(at(row, self.offset)) as f32,
        }
    }
}
