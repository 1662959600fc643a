//! Status codes and error messages.

use std::{
    any::Any,
    cell::Cell,
    ffi::{CStr, c_char},
    panic::{AssertUnwindSafe, catch_unwind},
};
use zipsplat::Error;

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_status {
    ZS_OK = 0,
    ZS_ERROR_ARGUMENT = 1,
    ZS_ERROR_IO = 2,
    ZS_ERROR_FORMAT = 3,
    ZS_ERROR_WEIGHTS = 4,
    ZS_ERROR_NO_DEVICE = 5,
    ZS_ERROR_OUT_OF_MEMORY = 6,
    ZS_ERROR_DRIVER = 7,
    ZS_ERROR_DEVICE_LOST = 8,
    ZS_ERROR_CANCELLED = 9,
    ZS_ERROR_UNSUPPORTED = 10,
    ZS_ERROR_INTERNAL = 11,
}

use zs_status::*;

pub(super) const STATUSES: [(zs_status, &CStr); 12] = [
    (ZS_OK, c"ZS_OK"),
    (ZS_ERROR_ARGUMENT, c"ZS_ERROR_ARGUMENT"),
    (ZS_ERROR_IO, c"ZS_ERROR_IO"),
    (ZS_ERROR_FORMAT, c"ZS_ERROR_FORMAT"),
    (ZS_ERROR_WEIGHTS, c"ZS_ERROR_WEIGHTS"),
    (ZS_ERROR_NO_DEVICE, c"ZS_ERROR_NO_DEVICE"),
    (ZS_ERROR_OUT_OF_MEMORY, c"ZS_ERROR_OUT_OF_MEMORY"),
    (ZS_ERROR_DRIVER, c"ZS_ERROR_DRIVER"),
    (ZS_ERROR_DEVICE_LOST, c"ZS_ERROR_DEVICE_LOST"),
    (ZS_ERROR_CANCELLED, c"ZS_ERROR_CANCELLED"),
    (ZS_ERROR_UNSUPPORTED, c"ZS_ERROR_UNSUPPORTED"),
    (ZS_ERROR_INTERNAL, c"ZS_ERROR_INTERNAL"),
];

#[unsafe(no_mangle)]
pub extern "C" fn zs_status_name(status: i32) -> *const c_char {
    let known = STATUSES.iter().find(|(known, _)| *known as i32 == status);
    known.map_or(c"unknown status", |(_, name)| name).as_ptr()
}

#[unsafe(no_mangle)]
pub extern "C" fn zs_last_error() -> *const c_char {
    LAST_ERROR.try_with(|last| last.0.as_ptr().cast()).unwrap_or(c"".as_ptr())
}

/// A thread's message at a fixed address. Cells: C may hold the pointer during a write.
struct Message(Box<[Cell<u8>]>);

/// Bytes, including NUL.
const MAX_MESSAGE: usize = 16 << 10;

impl Message {
    fn new() -> Self {
        Self(vec![Cell::new(0); MAX_MESSAGE].into())
    }

    fn set(&self, message: &str) {
        let end = (0..MAX_MESSAGE.min(message.len() + 1)).rev().find(|end| message.is_char_boundary(*end)).unwrap_or(0);
        let bytes = message.as_bytes()[..end].iter().map(|byte| if *byte == 0 { b' ' } else { *byte });
        self.0.iter().zip(bytes.chain([0])).for_each(|(to, from)| to.set(from));
    }
}

thread_local! {
    static LAST_ERROR: Message = Message::new();
}

pub(super) struct Failure {
    pub status: zs_status,
    pub message: String,
}

impl Failure {
    pub fn unsupported(message: impl Into<String>) -> Self {
        Self { status: ZS_ERROR_UNSUPPORTED, message: message.into() }
    }

    pub fn argument(what: impl Into<String>, found: impl ToString, expected: impl Into<String>) -> Self {
        Error::argument(what, found, expected).into()
    }

    fn panicked(payload: Box<dyn Any + Send>) -> Self {
        let text = payload.downcast_ref::<&str>().map(|text| text.to_string());
        let text = text.or_else(|| payload.downcast_ref::<String>().cloned());
        let message = format!("a bug in zipsplat: {}", text.unwrap_or_else(|| "a panic without a message".into()));
        Self { status: ZS_ERROR_INTERNAL, message }
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let status = match &error {
            Error::Argument { .. } => ZS_ERROR_ARGUMENT,
            Error::Io { .. } => ZS_ERROR_IO,
            Error::Format { .. } => ZS_ERROR_FORMAT,
            Error::Weights { .. } => ZS_ERROR_WEIGHTS,
            Error::NoDevice(_) => ZS_ERROR_NO_DEVICE,
            Error::Memory { .. } => ZS_ERROR_OUT_OF_MEMORY,
            Error::Driver { .. } => ZS_ERROR_DRIVER,
            Error::DeviceLost => ZS_ERROR_DEVICE_LOST,
            Error::Cancelled => ZS_ERROR_CANCELLED,
            _ => ZS_ERROR_INTERNAL,
        };
        Self { status, message: error.to_string() }
    }
}

/// Runs an entry point: catches panics and stores the message.
pub(super) fn guard(body: impl FnOnce() -> Result<(), Failure>) -> zs_status {
    let result = catch_unwind(AssertUnwindSafe(body)).unwrap_or_else(|payload| Err(Failure::panicked(payload)));
    let Err(Failure { status, message }) = result else { return ZS_OK };
    // Fails only on a thread that is ending.
    let _ = LAST_ERROR.try_with(|last| last.set(&message));
    status
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_ends_as_an_internal_error() {
        assert_eq!(guard(|| panic!("index {} of {}", 3, 2)), ZS_ERROR_INTERNAL);
        // SAFETY: this thread's message, read before the next call.
        let message = unsafe { CStr::from_ptr(zs_last_error()) };
        assert_eq!(message.to_str(), Ok("a bug in zipsplat: index 3 of 2"));
    }

    #[test]
    fn long_messages_are_cut_between_characters() {
        let message = Message::new();
        let found = || {
            let bytes: Vec<u8> = message.0.iter().map(Cell::get).collect();
            CStr::from_bytes_until_nul(&bytes).expect("it ends").to_str().expect("UTF-8").to_owned()
        };
        // Two bytes each: the last one does not fit before the NUL.
        message.set(&"ä".repeat(MAX_MESSAGE));
        assert_eq!(found().len(), MAX_MESSAGE - 2);
        for (text, expected) in [("a\0b", "a b"), ("", "")] {
            message.set(text);
            assert_eq!(found(), expected);
        }
    }

    #[test]
    fn numbers_and_names_agree() {
        for (index, (status, name)) in STATUSES.iter().enumerate() {
            assert_eq!(*status as usize, index);
            assert_eq!(format!("{status:?}").as_bytes(), name.to_bytes());
        }
    }
}
