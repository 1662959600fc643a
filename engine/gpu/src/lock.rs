//! Tables that threads share.

use std::sync::{Mutex, MutexGuard};

/// Locks even where a panicking thread held the lock: the data are plain tables.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|e| e.into_inner())
}
