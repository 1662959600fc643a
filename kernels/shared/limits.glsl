// Constants that kernels and host share; build.rs gives them to Rust as `kernels::limits`.
const uint GROUP_FOLD = 32768u; // 1-D dispatches above this many workgroups are folded to rows of this many.
const uint LINEAR_ROWS = 16u; // Rows of a linear layer that one workgroup owns.
const uint PANEL_COLUMNS = 32u; // Columns of a weight that lie side by side, so that a loop over rows reads on.
const uint Q8_GROUP = 32u; // Terms of a sum whose 8-bit weights share a scale.
const uint ATTENTION_ROWS = 16u; // Queries that one workgroup owns.
const uint NEAREST_ROWS = 8u; // Points that one workgroup finds the nearest targets of.
const uint RADIX = 256u; // Values of one digit of the radix sort.
const uint TILE = 16u; // Pixels a side of the tiles that pictures are cut into.
