//! Mutexes that serve on after a panic.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a mutex, also where a thread panicked while it held it. It is for what is whole between statements: a count, a map, a
/// list. What must change in several steps or not at all needs a check of its own.
///
/// ```
/// use segwild_files::lock;
/// use std::sync::Mutex;
///
/// let count = Mutex::new(1);
/// let panicked = std::panic::catch_unwind(|| {
///     let held = lock(&count);
///     assert_eq!(*held, 2, "a bug");
/// });
/// assert!(panicked.is_err() && count.is_poisoned());
/// *lock(&count) += 1;
/// assert_eq!(*lock(&count), 2);
/// ```
pub fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
