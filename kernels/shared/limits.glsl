// Constants that kernels and host share; build.rs gives them to Rust as `kernels::limits`.
const uint GROUP_FOLD = 32768u; // 1-D dispatches above this many workgroups are folded to rows of this many.
const uint RADIX = 256u; // Values of one digit of the radix sort.
