//! Device failures at every call.

mod commands;
mod contexts;
