//! Device loss and driver failures at every call of commands and contexts.

mod commands;
mod contexts;
