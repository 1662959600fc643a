//! The `zipsplat` command.

fn main() {}
