// Softmax attention of one head over one sequence on matrices of a whole workgroup (VK_NV_cooperative_matrix2), which the driver
// stages and reduces, with a running maximum (FlashAttention-2, Dao 2023).
//
// Q       [heads, sequences * queries, CHANNELS] f16, already scaled by 1 / sqrt(head size)
// K, V    [heads, sequences * keys, CHANNELS] f16; channels past the head's size are zeros
// Out     [sequences * queries, heads * dim] f16, saturated
//
// One workgroup owns ROWS queries of a head; keys and values come TILE at a time. Scores, softmax and sums are f32. Memory is
// linear in tokens. Factors are f16 only: devices are asked for workgroups' matrices of no other type.
#version 460
#pragma use_vulkan_memory_model
#pragma factor f16
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_NV_cooperative_matrix2 : require

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const uint SUBGROUPS = 4;
layout(constant_id = 2) const uint ROWS = 64;
layout(constant_id = 3) const uint TILE = 64;
layout(constant_id = 4) const uint CHANNELS = 64; // of a head in memory
layout(constant_id = 5) const uint WIDTH = 64;    // and in matrices, zeros from CHANNELS on

const float LOWEST = -1e30; // finite, so that a difference of two maxima is never NaN

layout(set = 0, binding = 0) readonly buffer Q { FACTOR q[]; };
layout(set = 0, binding = 1) readonly buffer K { FACTOR k[]; };
layout(set = 0, binding = 2) readonly buffer V { FACTOR v[]; };
layout(set = 0, binding = 3) writeonly buffer Out { FACTOR result[]; };

layout(push_constant) uniform Push {
    uint queries;
    uint keys;
    uint sequences;
    uint heads;
    uint dim;
};

#define Left(columns) coopmat<FACTOR_COMPONENT, gl_ScopeWorkgroup, ROWS, columns, gl_MatrixUseA>
#define Right(rows, columns) coopmat<FACTOR_COMPONENT, gl_ScopeWorkgroup, rows, columns, gl_MatrixUseB>
#define Scores coopmat<float, gl_ScopeWorkgroup, ROWS, TILE, gl_MatrixUseAccumulator>
#define Sums coopmat<float, gl_ScopeWorkgroup, ROWS, WIDTH, gl_MatrixUseAccumulator>
#define Result coopmat<FACTOR_COMPONENT, gl_ScopeWorkgroup, ROWS, WIDTH, gl_MatrixUseAccumulator>
// What lies outside a tensor is read as zero and not written.
#define Tensor tensorLayoutNV<2, gl_CooperativeMatrixClampModeConstantNV>

float larger(const in float a, const in float b) { return max(a, b); }

float plus(const in float a, const in float b) { return a + b; }

// The functions below are of one element of a matrix.

// Keys from `left` on of a tile do not exist.
float masked(const in uint row, const in uint key, const in float score, const in uint left) {
    return key < left ? score : LOWEST;
}

float raised(const in uint row, const in uint key, const in float highest, const in float other) {
    return max(highest, other);
}

float weight(const in uint row, const in uint key, const in float score, const in float highest) {
    return exp(score - highest);
}

float finished(const in uint row, const in uint channel, const in float sum, const in float total) {
    return float(to_FACTOR(sum / total));
}

void main() {
    uint head = gl_WorkGroupID.y;
    uint sequence = gl_WorkGroupID.z;
    uint first_query = gl_WorkGroupID.x * ROWS;
    uint head_sequence = head * sequences + sequence;
    uint kv_base = head_sequence * keys * CHANNELS;
    Tensor queries_of_head = createTensorLayoutNV(2, gl_CooperativeMatrixClampModeConstantNV);
    queries_of_head = setTensorLayoutDimensionNV(queries_of_head, queries, CHANNELS);
    Tensor keys_of_head = createTensorLayoutNV(2, gl_CooperativeMatrixClampModeConstantNV);
    keys_of_head = setTensorLayoutDimensionNV(keys_of_head, keys, CHANNELS);
    tensorViewNV<2, false, 1, 0> transposed = createTensorViewNV(2, false, 1, 0);

    Left(WIDTH) query;
    Tensor rows = sliceTensorLayoutNV(queries_of_head, first_query, ROWS, 0, WIDTH);
    coopMatLoadTensorNV(query, q, head_sequence * queries * CHANNELS, rows);

    // Of a row, every element of `highest` is its largest score so far; those of `totals` add up to the sum of its weights.
    Scores highest = Scores(LOWEST);
    Scores totals = Scores(0.0);
    Sums sums = Sums(0.0);
    // Unrolled, several tiles of keys and values would compete for registers.
    [[dont_unroll]] for (uint first_key = 0; first_key < keys; first_key += TILE) {
        Tensor tile = sliceTensorLayoutNV(keys_of_head, first_key, TILE, 0, WIDTH);
        Right(WIDTH, TILE) key;
        coopMatLoadTensorNV(key, k, kv_base, tile, transposed);
        Scores scores = coopMatMulAdd(query, key, Scores(0.0));
        if (first_key + TILE > keys) {
            coopMatPerElementNV(scores, scores, masked, keys - first_key);
        }

        Scores before = highest;
        coopMatReduceNV(highest, scores, gl_CooperativeMatrixReduceRowNV, larger);
        coopMatPerElementNV(highest, highest, raised, before);
        Scores kept;
        coopMatPerElementNV(kept, before, weight, highest);
        Scores weights;
        coopMatPerElementNV(weights, scores, weight, highest);
        totals = totals * kept + weights;
        // As wide as the sums; of equal elements the largest is any.
        Sums factor;
        coopMatReduceNV(factor, kept, gl_CooperativeMatrixReduceRowNV, larger);
        sums = sums * factor;

        Right(TILE, WIDTH) value;
        coopMatLoadTensorNV(value, v, kv_base, tile);
        sums = coopMatMulAdd(Left(TILE)(weights), value, sums);
    }

    Sums total;
    coopMatReduceNV(total, totals, gl_CooperativeMatrixReduceRowNV, plus);
    coopMatPerElementNV(sums, sums, finished, total);
    // Up to the end of this sequence and of this head.
    Tensor written = createTensorLayoutNV(2, gl_CooperativeMatrixClampModeConstantNV);
    written = setTensorLayoutDimensionNV(written, (sequence + 1) * queries, (head + 1) * dim);
    written = setTensorLayoutStrideNV(written, heads * dim, 1);
    written = sliceTensorLayoutNV(written, sequence * queries + first_query, ROWS, head * dim, WIDTH);
    coopMatStoreTensorNV(Result(sums), result, 0, written);
}
