use std::io::{Cursor, Write};
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

/// ZIP, as of `torch.save`.
pub fn archive(entries: &[(&str, &[u8])], compression: CompressionMethod) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(compression).with_alignment(64);
    for (name, bytes) in entries {
        zip.start_file(format!("pico/{name}"), options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

pub fn pickled(pickle: &[u8]) -> Vec<u8> {
    archive(&[("data.pkl", pickle)], CompressionMethod::Stored)
}

pub fn text(text: &str) -> Vec<u8> {
    [b"X".as_slice(), &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
}

pub fn int(value: usize) -> Vec<u8> {
    [b"J".as_slice(), &(value as i32).to_le_bytes()].concat()
}

pub fn tuple(items: &[Vec<u8>]) -> Vec<u8> {
    [b"(", items.concat().as_slice(), b"t"].concat()
}

pub fn global(module: &str, name: &str) -> Vec<u8> {
    format!("c{module}\n{name}\n").into_bytes()
}

pub fn call(module: &str, name: &str, arguments: &[Vec<u8>]) -> Vec<u8> {
    [global(module, name), tuple(arguments), b"R".to_vec()].concat()
}

pub fn dict(pairs: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let items: Vec<u8> = pairs.iter().flat_map(|(key, value)| [text(key), value.clone()].concat()).collect();
    [b"}(", items.as_slice(), b"u"].concat()
}

pub fn sizes(sizes: &[usize]) -> Vec<u8> {
    tuple(&sizes.iter().map(|&size| int(size)).collect::<Vec<_>>())
}

#[derive(Clone, Copy)]
pub struct View<'a> {
    pub kind: &'a str,
    pub key: &'a str,
    /// Length of the storage.
    pub elements: usize,
    pub offset: usize,
    pub shape: &'a [usize],
    pub strides: &'a [usize],
}

impl View<'_> {
    pub fn pickle(&self) -> Vec<u8> {
        let storage =
            tuple(&[text("storage"), global("torch", self.kind), text(self.key), text("cpu"), int(self.elements)]);
        let storage = [storage, b"Q".to_vec()].concat();
        let hooks = [global("collections", "OrderedDict"), b")R".to_vec()].concat();
        let (shape, strides) = (sizes(self.shape), sizes(self.strides));
        let arguments = [storage, int(self.offset), shape, strides, b"\x89".to_vec(), hooks];
        call("torch._utils", "_rebuild_tensor_v2", &arguments)
    }
}

pub fn row_major(shape: &[usize]) -> Vec<usize> {
    (0..shape.len()).map(|axis| shape[axis + 1..].iter().product()).collect()
}
