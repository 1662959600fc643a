// Constants shared with the host, there in `kernels::limits`.
const uint GROUP_FOLD = 32768u; // Workgroups per row of a folded 1-D dispatch.
const uint LINEAR_ROWS = 16u; // Rows of a linear layer per workgroup.
const uint PANEL_COLUMNS = 32u; // Columns per panel of a weight.
const uint Q8_GROUP = 32u; // Terms that share the scale of an 8-bit weight.
const uint ATTENTION_ROWS = 16u; // Queries per workgroup of attention.
const uint NEAREST_ROWS = 8u; // Points per workgroup of a nearest-target search.
const uint RADIX = 256u; // Values of a radix sort digit.
const uint TILE = 16u; // Side of an image tile in pixels.
