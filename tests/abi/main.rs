//! The C ABI, from C, C++ and Python.
//!
//! Unless stated otherwise, `unsafe` calls are sound: handles are live or NULL, structures have
//! their size set, strings end, arrays have their stated lengths, and all outlive the call.
#![allow(unsafe_code)]

mod arguments;
mod calls;
mod cameras;
mod captures;
mod compile;
mod cycles;
mod depth;
mod edit;
mod examples;
mod gradients;
mod header;
mod installation;
mod known_depth;
mod layout;
mod lost;
mod memory;
mod notes;
mod points;
mod random_calls;
mod refine;
mod refine_tokens;
mod same_bits;
mod threads;
