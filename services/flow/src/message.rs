//! What travels between actors.

use std::sync::Arc;

/// A message: it knows its size, its name, and whether it can be tried again.
///
/// ```
/// use segwild_flow::Message;
/// use std::sync::Arc;
/// #[derive(Clone)]
/// struct Photo { name: Arc<str>, pixels: Arc<Vec<u8>> }
/// impl Message for Photo {
///     fn bytes(&self) -> usize { self.pixels.len() }
///     fn label(&self) -> String { self.name.to_string() }
///     fn again(&self) -> Option<Self> { Some(self.clone()) }
/// }
/// ```
pub trait Message: Send + Sized + 'static {
    /// Memory it holds, in bytes, heap included: what the mailbox's byte limit counts.
    fn bytes(&self) -> usize {
        size_of_val(self)
    }

    /// Names the work for timelines, events and quarantine: the photo's name, say.
    fn label(&self) -> String {
        String::new()
    }

    /// A copy to try again with when handling fails; payloads are best behind an [`Arc`]. `None` (for messages
    /// that carry a reply channel, say): one failure is final.
    fn again(&self) -> Option<Self> {
        None
    }
}

macro_rules! plain {
    ($($t:ty),*) => {$(
        impl Message for $t {
            fn label(&self) -> String { format!("{self:?}") }
            fn again(&self) -> Option<Self> { Some(self.clone()) }
        }
    )*};
}
plain!((), bool, u8, u16, u32, u64, usize, i32, i64, f32, f64);

impl Message for String {
    fn bytes(&self) -> usize {
        size_of::<Self>() + self.capacity()
    }
    fn label(&self) -> String {
        self.clone()
    }
    fn again(&self) -> Option<Self> {
        Some(self.clone())
    }
}

impl<T: Copy + Send + 'static> Message for Vec<T> {
    fn bytes(&self) -> usize {
        size_of::<Self>() + self.capacity() * size_of::<T>()
    }
}

impl<T: Message + Sync> Message for Arc<T> {
    fn bytes(&self) -> usize {
        (**self).bytes()
    }
    fn label(&self) -> String {
        (**self).label()
    }
    fn again(&self) -> Option<Self> {
        Some(self.clone())
    }
}
