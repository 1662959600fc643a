// The rule by which one of several targets is taken that are about equally near to a point; after the push constants.
//
// Targets tie whose squared distances exceed the least by no more than the share `tie` of it; the first of them is taken. The
// mean of a cluster of two lies midway between both: without this rule the rounding of a sum would choose one.

// The most that a squared distance may be where the least is known.
float tie_limit(float least) { return least + tie * least; }
