//! The C ABI, as C, C++ and Python see it.

mod header;
