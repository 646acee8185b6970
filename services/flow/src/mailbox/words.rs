//! Mailboxes in words and numbers: their limits, refusals and figures.

use std::sync::Arc;

/// How much a mailbox may hold. Both limits are at least 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Messages.
    pub count: usize,
    /// Bytes, as [`Message::bytes`] counts them.
    pub bytes: usize,
}

impl Default for Limits {
    /// 64 messages, 256 MiB.
    fn default() -> Self {
        Self { count: 64, bytes: 256 << 20 }
    }
}

/// The mailbox takes no more: its receivers have gone, or it is being drained.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the mailbox of `{0}` is closed")]
pub struct Closed(pub Arc<str>);

/// Why [`Sender::try_send`] gave the message back.
#[derive(thiserror::Error)]
pub enum TrySendError<M> {
    /// No space now.
    #[error("the mailbox is full")]
    Full(M),
    /// No more for ever.
    #[error("the mailbox is closed")]
    Closed(M),
}

// Written by hand, so that messages need not be `Debug`.
impl<M> std::fmt::Debug for TrySendError<M> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Full(_) => "Full",
            Self::Closed(_) => "Closed",
        })
    }
}

/// Why there is no message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RecvError {
    /// None now.
    #[error("the mailbox is empty")]
    Empty,
    /// None any more.
    #[error("the mailbox is closed and empty")]
    Closed,
}

/// A mailbox's gauges and counters.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct MailboxStats {
    /// Whose it is.
    pub name: String,
    /// Messages queued.
    pub depth: usize,
    /// Bytes queued.
    pub bytes: usize,
    /// Most messages ever queued.
    pub high_water: usize,
    /// Most bytes ever queued.
    pub high_water_bytes: usize,
    /// Messages the work lane may hold.
    pub capacity: usize,
    /// Bytes the work lane may hold.
    pub capacity_bytes: usize,
    /// Messages sent.
    pub sent: u64,
    /// Messages taken out.
    pub received: u64,
    /// Sends that found the mailbox full.
    pub held_back: u64,
    /// Senders waiting for space now.
    pub waiting_senders: usize,
    /// Time senders have spent waiting for space (back-pressure), in seconds.
    pub back_pressure_s: f64,
    /// Whether it takes no more.
    pub closed: bool,
}
