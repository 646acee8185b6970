//! Every integration test of the crate in one program: it links once.

mod changes;
mod common;

mod document;
mod grpc;
mod http;
mod objects;
mod openapi;
