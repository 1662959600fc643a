//! A scene's file, or bytes in memory.

use std::borrow::Cow;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use super::file::open_file;
use crate::{Error, Result};

pub(super) struct Source<'a> {
    pub name: &'a Path,
    content: Content<'a>,
}

enum Content<'a> {
    File { file: File, length: u64 },
    Memory(Cursor<&'a [u8]>),
}

impl<'a> Source<'a> {
    pub(super) fn open(path: &'a Path) -> Result<Self> {
        let file = open_file(path)?;
        let length = file.metadata().map_err(|source| Error::io(path, source))?.len();
        Ok(Self { name: path, content: Content::File { file, length } })
    }

    pub(super) fn memory(name: &'a Path, bytes: &'a [u8]) -> Self {
        Self { name, content: Content::Memory(Cursor::new(bytes)) }
    }

    pub(super) fn length(&self) -> u64 {
        match &self.content {
            Content::File { length, .. } => *length,
            Content::Memory(bytes) => bytes.get_ref().len() as u64,
        }
    }

    pub(super) fn folder(&self) -> Option<&'a Path> {
        matches!(self.content, Content::File { .. }).then(|| self.name.parent().unwrap_or(Path::new("")))
    }

    pub(super) fn rest(&mut self) -> Result<Cow<'a, [u8]>> {
        match &mut self.content {
            Content::File { file, .. } => {
                let mut bytes = Vec::new();
                file.read_to_end(&mut bytes).map_err(|source| Error::io(self.name, source))?;
                Ok(Cow::Owned(bytes))
            }
            Content::Memory(bytes) => {
                let start = bytes.position() as usize;
                bytes.set_position(bytes.get_ref().len() as u64);
                Ok(Cow::Borrowed(&bytes.get_ref()[start..]))
            }
        }
    }
}

impl Read for Source<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match &mut self.content {
            Content::File { file, .. } => file.read(buffer),
            Content::Memory(bytes) => bytes.read(buffer),
        }
    }
}
