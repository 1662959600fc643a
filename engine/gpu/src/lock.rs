use std::sync::{Mutex, MutexGuard};

/// Locks a mutex even if poisoned: its tables have no invariants to break.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|e| e.into_inner())
}
