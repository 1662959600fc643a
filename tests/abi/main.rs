//! The C ABI, as C, C++ and Python see it.
#![allow(unsafe_code)] // It is called as C calls it.

mod arguments;
mod calls;
mod cameras;
mod captures;
mod compile;
mod cycles;
mod depth;
mod examples;
mod gradients;
mod header;
mod installation;
mod layout;
mod lost;
mod memory;
mod notes;
mod random_calls;
mod refine;
mod same_bits;
mod threads;
