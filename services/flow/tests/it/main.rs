//! The tests of this crate in one executable: each further one costs a link.

mod cache;
mod codec;
mod common;
mod compute;
mod events;
mod lease;
mod ledger;
mod live;
mod mailbox;
mod simulated;
mod simulation;
mod supervision;
mod system;
