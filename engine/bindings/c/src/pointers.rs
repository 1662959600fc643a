//! Arguments that come through pointers: handles, structures that grow, strings, arrays.

use super::status::{Failure, guard, zs_status};
use std::{
    ffi::{CStr, c_char},
    ops::ControlFlow,
};

type Result<T> = std::result::Result<T, Failure>;

/// Bytes of a pointer.
pub(super) const POINTER: usize = size_of::<*const ()>();

/// A structure that begins with its size, so that later versions can add fields at its end.
///
/// # Safety
/// `repr(C)`, without padding, its first field the u32 `struct_size`, and any bytes behind that are a value.
pub(super) unsafe trait Versioned: Copy {
    const NAME: &str;
    /// Size in the first version of this ABI.
    const FIRST_SIZE: usize;
    /// The values of fields that a caller's older structure lacks, and the whole where none is given.
    fn defaults() -> Self;
}

fn check_size<T: Versioned>(size: usize) -> Result<()> {
    if (T::FIRST_SIZE..=size_of::<T>()).contains(&size) {
        return Ok(());
    }
    let expected = format!("{} to {}; a larger one is of a newer header", T::FIRST_SIZE, size_of::<T>());
    Err(Failure::argument(format!("{}, struct_size", T::NAME), size, expected))
}

/// The size that a caller's structure says, one that can be.
///
/// # Safety
/// `pointer` points to a structure's first field.
unsafe fn given_size<T: Versioned>(pointer: *const T) -> Result<usize> {
    // SAFETY: the size is the first field of every version.
    let size = unsafe { pointer.cast::<u32>().read_unaligned() } as usize;
    check_size::<T>(size).map(|()| size)
}

/// A copy of a caller's structure; the defaults where it is NULL.
///
/// # Safety
/// `pointer` is NULL or points to as many bytes as its first field says.
pub(super) unsafe fn read_versioned<T: Versioned>(pointer: *const T) -> Result<T> {
    let mut value = T::defaults();
    if pointer.is_null() {
        return Ok(value);
    }
    // SAFETY: the caller's promise.
    let size = unsafe { given_size(pointer) }?;
    // SAFETY: the caller has `size` bytes there, and `T` at least as many.
    unsafe { std::ptr::copy_nonoverlapping(pointer.cast::<u8>(), (&raw mut value).cast::<u8>(), size) };
    Ok(value)
}

/// As [`read_versioned`], of a structure that has to be there.
///
/// # Safety
/// As [`read_versioned`].
pub(super) unsafe fn read_given<T: Versioned>(pointer: *const T) -> Result<T> {
    if pointer.is_null() {
        return Err(Failure::argument(T::NAME, "NULL", "a structure"));
    }
    // SAFETY: the caller's promise.
    unsafe { read_versioned(pointer) }
}

/// Copies of a caller's array of structures, all of one size; `count` 0 is an empty one, whatever the pointer.
///
/// # Safety
/// `pointer` is NULL or points to `count` structures, each of as many bytes as the first field of the first says.
pub(super) unsafe fn read_array<T: Versioned>(pointer: *const T, count: usize, name: &str) -> Result<Vec<T>> {
    if count == 0 {
        return Ok(Vec::new());
    }
    if pointer.is_null() {
        return Err(Failure::argument(name, "NULL", format!("{count} elements")));
    }
    // SAFETY: the caller's promise.
    let size = unsafe { given_size(pointer) }?;
    let most = isize::MAX as usize / size;
    if count > most {
        return Err(Failure::argument(format!("number of {name}"), count, format!("at most {most}")));
    }
    let element = |i: usize| {
        // SAFETY: the caller's promise; the size was checked not to wrap.
        let at = unsafe { pointer.byte_add(i * size) };
        // SAFETY: as above.
        match unsafe { given_size(at) }? {
            // SAFETY: as above.
            own if own == size => unsafe { read_versioned(at) },
            own => Err(Failure::argument(format!("{}, struct_size of {name}", T::NAME), own, format!("{size} in all"))),
        }
    };
    (0..count).map(element).collect()
}

/// Fills a caller's structure as far as it reaches; `struct_size` stays the caller's.
///
/// # Safety
/// As [`read_versioned`].
pub(super) unsafe fn write_versioned<T: Versioned>(pointer: *mut T, value: T) -> Result<()> {
    if pointer.is_null() {
        return Err(Failure::argument(T::NAME, "NULL", "a structure"));
    }
    // SAFETY: as in `read_versioned`.
    let size = unsafe { given_size(pointer) }?;
    let from = (&raw const value).cast::<u8>();
    // SAFETY: the caller has `size` bytes there, and `T` at least as many; the first four stay.
    unsafe { std::ptr::copy_nonoverlapping(from.add(4), pointer.cast::<u8>().add(4), size - 4) };
    Ok(())
}

/// Writes the defaults of the version that the caller knows.
///
/// # Safety
/// `pointer` is NULL or points to `size` bytes.
pub(super) unsafe fn write_defaults<T: Versioned>(pointer: *mut T, size: usize) -> zs_status {
    guard(|| {
        check_size::<T>(size)?;
        if pointer.is_null() {
            return Err(Failure::argument(T::NAME, "NULL", "a structure"));
        }
        // SAFETY: there is room for `size` bytes, as the caller says.
        unsafe { pointer.cast::<u32>().write_unaligned(size as u32) };
        // SAFETY: as above, and the size was just written.
        unsafe { write_versioned(pointer, T::defaults()) }
    })
}

/// Runs a constructor and hands its object out; NULL where it fails.
///
/// # Safety
/// `out` is NULL or can be written.
pub(super) unsafe fn produce<T>(out: *mut *mut T, body: impl FnOnce() -> Result<T>) -> zs_status {
    if !out.is_null() {
        // SAFETY: the caller says that it can be written.
        unsafe { out.write(std::ptr::null_mut()) };
    }
    guard(|| {
        if out.is_null() {
            return Err(Failure::argument("the pointer to the result", "NULL", "where to put it"));
        }
        let object = Box::new(body()?);
        // SAFETY: as above.
        unsafe { out.write(Box::into_raw(object)) };
        Ok(())
    })
}

/// Takes an object back and drops it; NULL is none.
///
/// # Safety
/// `handle` is NULL or came from [`produce`] and is used nowhere any more.
pub(super) unsafe fn destroy<T>(handle: *mut T) {
    if !handle.is_null() {
        // SAFETY: made by `Box::into_raw` in `produce`, and given back once. There is no status to report a panic with, and
        // its message is kept.
        let _ = guard(|| {
            drop(unsafe { Box::from_raw(handle) });
            Ok(())
        });
    }
}

/// An object of a call.
///
/// # Safety
/// `handle` is NULL or an object that lives during the call.
pub(super) unsafe fn borrow<'a, T>(handle: *const T, name: &str) -> Result<&'a T> {
    // SAFETY: the caller's promise.
    unsafe { handle.as_ref() }.ok_or_else(|| Failure::argument(name, "NULL", "an object that was created"))
}

/// An array of a call; `count` 0 is an empty one, whatever the pointer.
///
/// # Safety
/// `pointer` is NULL or points to `count` elements that nobody writes during the call.
pub(super) unsafe fn array<'a, T>(pointer: *const T, count: usize, name: &str) -> Result<&'a [T]> {
    check_array(pointer, count, name)?;
    // SAFETY: checked above, and the caller's promise.
    Ok(if count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(pointer, count) } })
}

/// As [`array`], to write to.
///
/// # Safety
/// As [`array`], and nobody reads it either.
pub(super) unsafe fn array_mut<'a, T>(pointer: *mut T, count: usize, name: &str) -> Result<&'a mut [T]> {
    check_array(pointer, count, name)?;
    // SAFETY: checked above, and the caller's promise.
    Ok(if count == 0 { &mut [] } else { unsafe { std::slice::from_raw_parts_mut(pointer, count) } })
}

fn check_array<T>(pointer: *const T, count: usize, name: &str) -> Result<()> {
    if count == 0 {
        return Ok(());
    }
    if pointer.is_null() {
        return Err(Failure::argument(name, "NULL", format!("{count} elements")));
    }
    let most = isize::MAX as usize / size_of::<T>();
    if count > most {
        return Err(Failure::argument(format!("number of {name}"), count, format!("at most {most}")));
    }
    if !pointer.is_aligned() {
        return Err(Failure::argument(name, format!("{pointer:p}"), format!("a multiple of {}", align_of::<T>())));
    }
    Ok(())
}

/// A string of a call.
///
/// # Safety
/// `pointer` is NULL or a string that ends with NUL.
pub(super) unsafe fn text<'a>(pointer: *const c_char, name: &str) -> Result<&'a str> {
    // SAFETY: the caller's promise.
    let found = unsafe { optional_text(pointer, name) }?;
    found.ok_or_else(|| Failure::argument(name, "NULL", "a string"))
}

/// As [`text`]; NULL is `None`.
///
/// # Safety
/// As [`text`].
pub(super) unsafe fn optional_text<'a>(pointer: *const c_char, name: &str) -> Result<Option<&'a str>> {
    if pointer.is_null() {
        return Ok(None);
    }
    // SAFETY: the caller's promise.
    let bytes = unsafe { CStr::from_ptr(pointer) };
    bytes.to_str().map(Some).map_err(|error| Failure::argument(name, error, "UTF-8"))
}

/// The meaning of a progress callback's answer.
pub(super) fn flow(stop: i32) -> ControlFlow<()> {
    if stop == 0 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A structure that had no `added` in the first version.
    #[repr(C)]
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Grown {
        struct_size: u32,
        first: u32,
        added: u64,
    }

    // SAFETY: repr(C), two u32 and a u64: no padding.
    unsafe impl Versioned for Grown {
        const NAME: &str = "grown";
        const FIRST_SIZE: usize = 8;
        fn defaults() -> Self {
            Self { struct_size: 16, first: 0, added: 7 }
        }
    }

    #[test]
    fn arrays_of_older_structures_get_defaults() {
        let older = [[8u32, 1], [8, 2], [8, 3]];
        // SAFETY: three structures of the size that they say.
        let found = unsafe { read_array::<Grown>(older.as_ptr().cast(), 3, "things") };
        let expected = [1, 2, 3].map(|first| Grown { struct_size: 8, first, added: 7 });
        assert!(found.is_ok_and(|found| found == expected));
    }

    #[test]
    fn elements_of_other_sizes_are_refused() {
        let mixed = [[8u32, 1], [16, 2], [8, 3]];
        // SAFETY: three structures of the size that the first of them says.
        let found = unsafe { read_array::<Grown>(mixed.as_ptr().cast(), 3, "things") };
        let message = found.err().map(|failure| failure.message).unwrap_or_default();
        assert!(message.contains("struct_size of things") && message.contains("16"), "{message}");
    }
}
