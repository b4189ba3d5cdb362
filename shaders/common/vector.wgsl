// Values of a vector that one invocation makes, 128 apart: sums over a workgroup then cost little beside the loads. No bindings, no
// entry points.
const EACH: u32 = 8u;
