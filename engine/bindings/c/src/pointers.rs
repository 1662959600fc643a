//! Arguments: handles, versioned structures, strings, arrays, flags, enumerations.

use super::status::{Failure, guard, zs_status};
use std::ffi::{CStr, CString, c_char};
use zipsplat::Error;

type Result<T> = std::result::Result<T, Failure>;

/// A structure that begins with its size, so that later versions can append fields. Zero is every
/// field's default, also for NULL and for missing fields.
///
/// # Safety
/// `repr(C)` with padding at most at the end; the first field is the u32 `struct_size`; all other
/// bit patterns are valid.
pub unsafe trait Versioned: Copy {
    /// Name in the header.
    const NAME: &str;
    /// Size in the first version of this ABI.
    const FIRST_SIZE: usize = size_of::<Self>();

    /// Returns the field `reserved`, which must be 0, or 0.
    fn reserved(&self) -> u32;

    /// Returns zeros with `struct_size` set.
    fn new() -> Self {
        // SAFETY: all bit patterns are valid.
        let mut value: Self = unsafe { std::mem::zeroed() };
        // SAFETY: the size is the first field.
        unsafe { (&raw mut value).cast::<u32>().write(size_of::<Self>() as u32) };
        value
    }
}

/// Implements [`Versioned`] for structures unchanged since this ABI's first version: their names,
/// followed by `{ reserved }` if they have that field.
macro_rules! versioned {
    ($($name:ident $({ $reserved:ident })?),*) => {
        $(
            // SAFETY: integers, floats, pointers and optional functions, ordered without padding.
            unsafe impl $crate::pointers::Versioned for $name {
                const NAME: &str = stringify!($name);

                fn reserved(&self) -> u32 {
                    0 $(+ self.$reserved)?
                }
            }
        )*
    };
}

fn check_size<T: Versioned>(size: usize) -> Result<()> {
    if (T::FIRST_SIZE..=size_of::<T>()).contains(&size) {
        return Ok(());
    }
    let expected = format!("{} to {}; a larger one is of a newer header", T::FIRST_SIZE, size_of::<T>());
    Err(Failure::argument(format!("{}, struct_size", T::NAME), size, expected))
}

/// # Safety
/// `pointer` points to a structure's first field.
unsafe fn given_size<T: Versioned>(pointer: *const T) -> Result<usize> {
    // SAFETY: the size is the first field of every version.
    let size = unsafe { pointer.cast::<u32>().read_unaligned() } as usize;
    check_size::<T>(size).map(|()| size)
}

/// Copies a caller's structure; NULL is all zeros.
///
/// # Safety
/// `pointer` is NULL or points to as many bytes as its first field states.
pub(super) unsafe fn read_versioned<T: Versioned>(pointer: *const T) -> Result<T> {
    // SAFETY: the caller's promise.
    unsafe { read_named(pointer, T::NAME) }
}

/// # Safety
/// As [`read_versioned`].
unsafe fn read_named<T: Versioned>(pointer: *const T, name: &str) -> Result<T> {
    let mut value = T::new();
    if pointer.is_null() {
        return Ok(value);
    }
    // SAFETY: the caller's promise.
    let size = unsafe { given_size(pointer) }?;
    // SAFETY: the caller has `size` bytes there, and `T` at least as many.
    unsafe { std::ptr::copy_nonoverlapping(pointer.cast::<u8>(), (&raw mut value).cast::<u8>(), size) };
    match value.reserved() {
        0 => Ok(value),
        other => Err(Failure::argument(format!("{name}, reserved"), other, "0")),
    }
}

/// # Safety
/// As [`read_versioned`].
pub(super) unsafe fn read_given<T: Versioned>(pointer: *const T) -> Result<T> {
    if pointer.is_null() {
        return Err(Failure::argument(T::NAME, "NULL", "a structure"));
    }
    // SAFETY: the caller's promise.
    unsafe { read_versioned(pointer) }
}

/// Returns the size of each of an array's structures. With `count` 0 the pointer is ignored.
///
/// # Safety
/// `pointer` is NULL or points to `count` structures of the size in the first `struct_size`.
pub(super) unsafe fn checked_array<T: Versioned>(pointer: *const T, count: usize, name: &str) -> Result<usize> {
    if count == 0 {
        return Ok(size_of::<T>());
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
    for i in 0..count {
        // SAFETY: the caller's promise; the size was checked not to wrap.
        let own = unsafe { given_size(pointer.byte_add(i * size)) }?;
        if own != size {
            let found = format!("{}, struct_size of {name}", T::NAME);
            return Err(Failure::argument(found, own, format!("{size} in all")));
        }
    }
    Ok(size)
}

/// Copies an array of equally sized structures.
///
/// # Safety
/// As [`checked_array`].
pub(super) unsafe fn read_array<T: Versioned>(pointer: *const T, count: usize, name: &str) -> Result<Vec<T>> {
    // SAFETY: the caller's promise.
    let size = unsafe { checked_array(pointer, count, name) }?;
    // SAFETY: the caller's promise; the size was checked not to wrap.
    let element = |i: usize| unsafe { read_named(pointer.byte_add(i * size), &format!("{name} {i}")) };
    (0..count).map(element).collect()
}

/// Fills a caller's structure up to its `struct_size`, which stays unchanged.
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

/// Fills an array of equally sized structures, whose sizes [`checked_array`] checked.
///
/// # Safety
/// `pointer` points to as many structures as `values` has.
pub(super) unsafe fn write_array<T: Versioned>(pointer: *mut T, values: impl Iterator<Item = T>) -> Result<()> {
    // SAFETY: the caller's promise.
    let size = unsafe { given_size(pointer) }?;
    for (i, value) in values.enumerate() {
        // SAFETY: the caller's promise.
        unsafe { write_versioned(pointer.byte_add(i * size), value) }?;
    }
    Ok(())
}

/// Runs a constructor and outputs its object, or NULL on failure.
///
/// # Safety
/// `out` is NULL or writable.
pub(super) unsafe fn produce<T>(out: *mut *mut T, body: impl FnOnce() -> Result<T>) -> zs_status {
    if !out.is_null() {
        // SAFETY: the caller guarantees that it is writable.
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

/// # Safety
/// `handle` is NULL or came from [`produce`] and is no longer used.
pub(super) unsafe fn destroy<T>(handle: *mut T) {
    if !handle.is_null() {
        // SAFETY: created by `Box::into_raw` in `produce` and destroyed once. A panic has no status
        // to return, but its message is kept.
        let _ = guard(|| {
            drop(unsafe { Box::from_raw(handle) });
            Ok(())
        });
    }
}

/// # Safety
/// `handle` is NULL or an object that outlives the call.
pub(super) unsafe fn borrow<'a, T>(handle: *const T, name: &str) -> Result<&'a T> {
    // SAFETY: the caller's promise.
    unsafe { handle.as_ref() }.ok_or_else(|| Failure::argument(name, "NULL", "an object that was created"))
}

/// Writes a description of an object.
///
/// # Safety
/// As [`borrow`] and [`write_versioned`].
pub(super) unsafe fn describe<T, I: Versioned>(
    handle: *const T,
    name: &str,
    info: *mut I,
    of: impl FnOnce(&T) -> Result<I>,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's promise.
        let found = of(unsafe { borrow(handle, name) }?)?;
        // SAFETY: the caller's promise.
        unsafe { write_versioned(info, found) }
    })
}

/// # Safety
/// `to` is NULL or writable.
pub(super) unsafe fn put<T>(to: *mut T, value: T, name: &str) -> Result<()> {
    if to.is_null() {
        return Err(Failure::argument(name, "NULL", "where to put it"));
    }
    // SAFETY: not NULL, and the caller's promise.
    unsafe { to.write(value) };
    Ok(())
}

/// With `count` 0 the pointer is ignored.
///
/// # Safety
/// `pointer` is NULL or points to `count` elements that are not written during the call.
pub(super) unsafe fn array<'a, T>(pointer: *const T, count: usize, name: &str) -> Result<&'a [T]> {
    check_array(pointer, count, name)?;
    // SAFETY: checked above, and the caller's promise.
    Ok(if count == 0 { &[] } else { unsafe { std::slice::from_raw_parts(pointer, count) } })
}

/// # Safety
/// As [`array`], without concurrent reads.
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

/// # Safety
/// `pointer` is NULL or a NUL-terminated string.
pub(super) unsafe fn text<'a>(pointer: *const c_char, name: &str) -> Result<&'a str> {
    // SAFETY: the caller's promise.
    let found = unsafe { optional_text(pointer, name) }?;
    found.ok_or_else(|| Failure::argument(name, "NULL", "a string"))
}

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

/// Copies text, with spaces for NUL.
pub(super) fn c_text(text: &str) -> CString {
    CString::new(text.replace('\0', " ")).expect("no NUL")
}

pub(super) fn element<T>(photos: &[T], index: usize) -> Result<&T> {
    let expected = || format!("a number below {}", photos.len());
    photos.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))
}

pub(super) fn flag(name: &str, value: u32) -> Result<bool> {
    match value {
        0 | 1 => Ok(value == 1),
        other => Err(Failure::argument(name, other, "0 or 1")),
    }
}

/// Returns the meaning of a constant of an `enumeration`, whose `meanings` are in its order.
pub(super) fn meaning<T, const N: usize>(
    name: &str,
    value: i32,
    enumeration: &str,
    meanings: [T; N],
) -> zipsplat::Result<T> {
    let found = usize::try_from(value).ok().and_then(|value| meanings.into_iter().nth(value));
    found.ok_or_else(|| Error::argument(name, value, format!("a {enumeration}")))
}

#[cfg(test)]
mod tests {
    use super::*;

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

        fn reserved(&self) -> u32 {
            0
        }
    }

    #[test]
    fn arrays_of_older_structures_get_defaults() {
        let older = [[8u32, 1], [8, 2], [8, 3]];
        // SAFETY: three structures of their stated size.
        let found = unsafe { read_array::<Grown>(older.as_ptr().cast(), 3, "things") };
        let expected = [1, 2, 3].map(|first| Grown { struct_size: 8, first, added: 0 });
        assert!(found.is_ok_and(|found| found == expected));
    }

    #[test]
    fn elements_of_other_sizes_are_refused() {
        let mixed = [[8u32, 1], [16, 2], [8, 3]];
        // SAFETY: three structures of the first one's stated size.
        let found = unsafe { read_array::<Grown>(mixed.as_ptr().cast(), 3, "things") };
        let message = found.err().map(|failure| failure.message).unwrap_or_default();
        assert!(message.contains("struct_size of things") && message.contains("16"), "{message}");
    }
}
