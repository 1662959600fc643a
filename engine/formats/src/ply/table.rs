//! PLY elements (Turk 1994) with scalar properties, binary little endian or ASCII.

use std::io::{Chain, Cursor, Read};
use std::path::Path;

use super::ANTIALIASED;
use crate::Error;
use crate::scalar::{Scalar, first};
use crate::source::Source;

pub(super) const MAX_HEADER: usize = 1 << 16;
/// Rows per read: files are never entirely in memory.
const BATCH: usize = 1 << 16;

pub(super) enum Fault {
    Unread(std::io::Error),
    Damaged { offset: u64, reason: String },
}

impl Fault {
    pub(super) fn of(self, path: &Path) -> Error {
        match self {
            Self::Unread(source) => Error::io(path, source),
            Self::Damaged { offset, reason } => Error::format(path, Some(offset), reason),
        }
    }
}

pub(super) type Parsed<T> = Result<T, Fault>;

pub(super) struct Ply<'a> {
    pub antialiased: bool,
    ascii: bool,
    elements: Vec<Element>,
    values: Chain<Cursor<Vec<u8>>, Source<'a>>,
    passed: usize,
    body: u64,
    body_bytes: u64,
}

impl<'a> Ply<'a> {
    /// Compares binary files' counts with their length before allocating.
    pub(super) fn open(mut source: Source<'a>) -> Parsed<Self> {
        let (mut start, length) = (Vec::new(), source.length());
        source.by_ref().take(MAX_HEADER as u64).read_to_end(&mut start).map_err(Fault::Unread)?;
        let Header { antialiased, ascii, elements, body } = Header::parse(&start)?;
        let body_bytes = length.saturating_sub(body as u64);
        let values = Cursor::new(start.split_off(body)).chain(source);
        Ok(Self { antialiased, ascii, elements, values, passed: 0, body: body as u64, body_bytes })
    }

    pub(super) fn declared(&self, element: &str, property: &str) -> Option<Scalar> {
        let element = self.elements.iter().find(|found| found.name == element)?;
        element.properties.iter().find(|(name, _)| name == property).map(|(_, scalar)| *scalar)
    }

    pub(super) fn has_element(&self, element: &str) -> bool {
        self.elements.iter().any(|found| found.name == element)
    }

    pub(super) fn table(&self, name: &str) -> Parsed<Table> {
        let Some(position) = self.elements.iter().position(|element| element.name == name) else {
            return Err(self.fault(format!("the header names no {name} element")));
        };
        if let Some(element) = self.elements[..=position].iter().find(|element| element.has_list) {
            return Err(self.fault(format!("element {} has a list property, expected scalars", element.name)));
        }
        let element = &self.elements[position];
        if element.properties.is_empty() {
            return Err(self.fault(format!("the {name} element has no properties")));
        }
        let mut table = Table {
            position,
            count: element.count,
            row_bytes: 0,
            columns: Vec::new(),
            body: self.body,
            name: name.into(),
        };
        for (name, scalar) in &element.properties {
            let scalar = if self.ascii { Scalar::F32 } else { *scalar };
            table.columns.push((name.clone(), Column { offset: table.row_bytes, scalar }));
            table.row_bytes += scalar.size();
        }
        let unit = |element: &Element| if self.ascii { element.properties.len() } else { element.row_bytes() };
        let values =
            |sum: u64, element: &Element| sum.checked_add((element.count as u64).checked_mul(unit(element) as u64)?);
        let end = self.elements[..=position].iter().try_fold(0, values);
        // An ASCII value takes a digit and, except for the last, a separator.
        let most = if self.ascii { self.body_bytes / 2 + 1 } else { self.body_bytes };
        if end.is_none_or(|end| end > most) {
            return Err(self.truncated(element));
        }
        Ok(table)
    }

    /// Passes an element's rows to `each`, in batches with the index of their first row. ASCII
    /// values become f32.
    pub(super) fn rows(&mut self, table: &Table, mut each: impl FnMut(usize, &[u8]) -> Parsed<()>) -> Parsed<()> {
        if table.position < self.passed {
            let (name, before) = (&table.name, &self.elements[self.passed - 1].name);
            return Err(self.fault(format!("found element {name} before element {before}, expected it behind")));
        }
        let before = self.passed..table.position;
        self.passed = table.position + 1;
        if self.ascii {
            return self.text_rows(before, table, each);
        }
        let skipped: u64 = self.elements[before].iter().map(|e| e.count as u64 * e.row_bytes() as u64).sum();
        let mut skip = self.values.by_ref().take(skipped);
        std::io::copy(&mut skip, &mut std::io::sink()).map_err(Fault::Unread)?;
        let mut rows = vec![0; table.row_bytes * BATCH.min(table.count)];
        for start in (0..table.count).step_by(BATCH) {
            let batch = &mut rows[..table.row_bytes * BATCH.min(table.count - start)];
            self.values.read_exact(batch).map_err(Fault::Unread)?;
            each(start, batch)?;
        }
        Ok(())
    }

    fn text_rows(
        &mut self,
        before: std::ops::Range<usize>,
        table: &Table,
        mut each: impl FnMut(usize, &[u8]) -> Parsed<()>,
    ) -> Parsed<()> {
        // Bounded by the count, which `table` checked.
        let mut body = Vec::new();
        self.values.read_to_end(&mut body).map_err(Fault::Unread)?;
        let skipped = self.elements[before].iter().map(|element| element.count * element.properties.len()).sum();
        let element = &self.elements[table.position];
        let mut tokens = body.split(u8::is_ascii_whitespace).filter(|token| !token.is_empty()).skip(skipped);
        let mut rows = Vec::with_capacity(table.count * table.row_bytes);
        for i in 0..table.count * table.columns.len() {
            let (row, property) = (i / table.columns.len(), &table.columns[i % table.columns.len()].0);
            let token = tokens.next().ok_or_else(|| self.truncated(element))?;
            let value = std::str::from_utf8(token).ok().and_then(|token| token.parse::<f32>().ok());
            let Some(value) = value else {
                let found = String::from_utf8_lossy(&token[..token.len().min(32)]);
                let reason = format!("{} {row}, {property}: found {found:?}, expected a number", table.name);
                return Err(self.fault(reason));
            };
            rows.extend_from_slice(&value.to_le_bytes());
        }
        each(0, &rows)
    }

    pub(super) fn fault(&self, reason: String) -> Fault {
        Fault::Damaged { offset: self.body, reason }
    }

    fn truncated(&self, element: &Element) -> Fault {
        let Element { name, count, .. } = element;
        let width = if self.ascii {
            format!("{} values", element.properties.len())
        } else {
            format!("{} bytes", element.row_bytes())
        };
        let rows = if name == "vertex" { "vertices".into() } else { format!("rows of {name}") };
        let follow = self.body_bytes;
        self.fault(format!("truncated: the header promises {count} {rows} of {width}, {follow} bytes follow it"))
    }
}

pub(super) struct Table {
    position: usize,
    name: String,
    pub count: usize,
    pub row_bytes: usize,
    columns: Vec<(String, Column)>,
    body: u64,
}

impl Table {
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.columns.iter().map(|(name, _)| name.as_str())
    }

    pub(super) fn column(&self, name: &str) -> Parsed<Column> {
        let found = self.columns.iter().find(|(column, _)| column == name);
        found.map(|(_, column)| *column).ok_or_else(|| {
            let names = self.names().collect::<Vec<_>>().join(", ");
            self.fault(format!("element {} has no property {name}, only {names}", self.name))
        })
    }

    pub(super) fn typed(&self, name: &str, scalar: Scalar) -> Parsed<Column> {
        let column = self.column(name)?;
        if column.scalar != scalar {
            let reason =
                format!("{}, {name}: found {}, expected {}", self.name, name_of(column.scalar), name_of(scalar));
            return Err(self.fault(reason));
        }
        Ok(column)
    }

    pub(super) fn fault(&self, reason: String) -> Fault {
        Fault::Damaged { offset: self.body, reason }
    }
}

struct Header {
    antialiased: bool,
    ascii: bool,
    elements: Vec<Element>,
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
            return Err(Fault::Damaged { offset: 0, reason: "does not start with \"ply\"".into() });
        }
        let (mut antialiased, mut ascii) = (false, None);
        let mut elements: Vec<Element> = Vec::new();
        let mut offset = 0;
        for line in bytes[..bytes.len().min(MAX_HEADER)].split_inclusive(|&byte| byte == b'\n') {
            let text = String::from_utf8_lossy(line);
            let damaged = |reason| Fault::Damaged { offset: offset as u64, reason };
            let fault = |reason: &str| damaged(format!("{reason}: {:?}", text.trim()));
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
                    let known = SCALARS.iter().find(|(_, names)| names.contains(&scalar));
                    let (scalar, _) = known.ok_or_else(|| fault("unknown type"))?;
                    let element = elements.last_mut().ok_or_else(|| fault("a property before any element"))?;
                    element.properties.push((name.into(), *scalar));
                }
                ["end_header"] => {
                    let ascii = ascii.ok_or_else(|| fault("no format line before"))?;
                    return Ok(Self { antialiased, ascii, elements, body: offset + line.len() });
                }
                ["comment", name, mode] if name.eq_ignore_ascii_case(ANTIALIASED[0]) => {
                    antialiased = mode.eq_ignore_ascii_case(ANTIALIASED[1]);
                }
                // Postshot's tag.
                ["comment", name, flag] if name.eq_ignore_ascii_case("antialiased") => antialiased = flag == "1",
                ["ply"] | ["comment" | "obj_info", ..] | [] => {}
                _ => return Err(fault("not a line of a PLY header")),
            }
            offset += line.len();
        }
        Err(Fault::Damaged { offset: offset as u64, reason: "the header does not end".into() })
    }
}

/// Names of scalars, in the first and in a later spelling.
const SCALARS: [(Scalar, [&str; 2]); 8] = [
    (Scalar::I8, ["char", "int8"]),
    (Scalar::U8, ["uchar", "uint8"]),
    (Scalar::I16, ["short", "int16"]),
    (Scalar::U16, ["ushort", "uint16"]),
    (Scalar::I32, ["int", "int32"]),
    (Scalar::U32, ["uint", "uint32"]),
    (Scalar::F32, ["float", "float32"]),
    (Scalar::F64, ["double", "float64"]),
];

fn name_of(scalar: Scalar) -> &'static str {
    SCALARS.iter().find(|(known, _)| *known == scalar).map_or("", |(_, names)| names[0])
}

#[derive(Clone, Copy)]
pub(super) struct Column {
    offset: usize,
    scalar: Scalar,
}

impl Column {
    pub(super) fn read(self, row: &[u8]) -> f32 {
        self.scalar.read(&row[self.offset..])
    }

    pub(super) fn word(self, row: &[u8]) -> u32 {
        u32::from_le_bytes(first(&row[self.offset..]))
    }
}
