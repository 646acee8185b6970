//! The tests of this crate in one executable: each further one costs a link.

mod artefacts;
mod batch;
mod engine;
mod nats;
mod worker;
