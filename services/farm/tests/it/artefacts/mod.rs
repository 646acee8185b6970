//! Stores of artefacts, each on its real server, and the folders and runs that go through them.

mod folders;
mod runs;
mod servers;
mod stores;
mod sweeps;
