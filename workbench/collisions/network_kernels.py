# pyright: basic, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
"""Warp kernels of the networks, one frame (Eq. 1).  Matrices as their files hold them, float16; sums in float32."""

import warp as wp

LANES = 16  # outputs a block

wp.set_module_options({"enable_backward": False})

# A block: for each input, its factors for 16 outputs.  In C++, with the compiler's vector type (see `posing_kernels`).
_DENSE_BLOCK = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    typedef _Float16 halves __attribute__((vector_size(32), aligned(2)));
    const int count = inputs.shape[0];
    const halves* factor = reinterpret_cast<const halves*>(blocks.data) + size_t(block) * count;
    const float* input = inputs.data;
    lanes sum[4] = {};  // so that additions need not wait for each other
    int k = 0;
    for (; k + 4 <= count; k += 4)
        for (int i = 0; i < 4; ++i) sum[i] += input[k + i] * __builtin_convertvector(factor[k + i], lanes);
    for (; k < count; ++k) sum[0] += input[k] * __builtin_convertvector(factor[k], lanes);
    const lanes* shift = reinterpret_cast<const lanes*>(bias.data) + block;
    reinterpret_cast<lanes*>(outputs.data)[block] = *shift + ((sum[0] + sum[1]) + (sum[2] + sum[3]));
"""


@wp.func_native(_DENSE_BLOCK)
def dense_block(
    block: int,
    blocks: wp.array(dtype=wp.float16),
    bias: wp.array(dtype=wp.float32),
    inputs: wp.array(dtype=wp.float32),
    outputs: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def dense(
    blocks: wp.array(dtype=wp.float16),
    bias: wp.array(dtype=wp.float32),
    inputs: wp.array(dtype=wp.float32),
    outputs: wp.array(dtype=wp.float32),
):
    """W x + b; outputs in whole blocks of LANES."""
    dense_block(wp.tid(), blocks, bias, inputs, outputs)


@wp.func
def sigmoid(x: float):
    return 1.0 / (1.0 + wp.exp(-x))


@wp.kernel
def gru_step(
    from_input: wp.array(dtype=wp.float32),
    from_hidden: wp.array(dtype=wp.float32),
    hidden: wp.array(dtype=wp.float32),
):
    """The gates of a GRU (reset, update, new), and its next hidden state in place of the last."""
    i = wp.tid()
    size = hidden.shape[0]
    reset = sigmoid(from_input[i] + from_hidden[i])
    update = sigmoid(from_input[size + i] + from_hidden[size + i])
    new = wp.tanh(from_input[2 * size + i] + reset * from_hidden[2 * size + i])
    hidden[i] = (1.0 - update) * new + update * hidden[i]


# Sums in sixteen lanes: one after the other, as LayerNorm is written, these took as long as the matrices beside them.
_NORMALISE = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    const int size = values.shape[1], blocks = size / 16;
    float* const value = values.data + size_t(row) * size;
    lanes* const block = reinterpret_cast<lanes*>(value);
    auto total = [](const lanes& of) {
        float sum = 0;
        for (int i = 0; i < 16; ++i) sum += of[i];
        return sum;
    };
    lanes sums = {};
    for (int k = 0; k < blocks; ++k) sums += block[k];
    float mean = total(sums);
    for (int i = 16 * blocks; i < size; ++i) mean += value[i];
    mean /= size;
    lanes squares = {};
    for (int k = 0; k < blocks; ++k) squares += (block[k] - mean) * (block[k] - mean);
    float variance = total(squares);
    for (int i = 16 * blocks; i < size; ++i) variance += (value[i] - mean) * (value[i] - mean);
    const float factor = 1.0f / __builtin_sqrtf(variance / size + epsilon);
    for (int k = 0; k < blocks; ++k)
        block[k] = (block[k] - mean) * factor * reinterpret_cast<const lanes*>(scale.data)[k]
            + reinterpret_cast<const lanes*>(shift.data)[k];
    for (int i = 16 * blocks; i < size; ++i) value[i] = (value[i] - mean) * factor * scale.data[i] + shift.data[i];
"""


@wp.func_native(_NORMALISE)
def normalise(
    row: int,
    scale: wp.array(dtype=wp.float32),
    shift: wp.array(dtype=wp.float32),
    epsilon: float,
    values: wp.array2d(dtype=wp.float32),
):
    """LayerNorm of a row, in place."""


@wp.kernel
def rectify_and_normalise(
    scale: wp.array(dtype=wp.float32),
    shift: wp.array(dtype=wp.float32),
    epsilon: float,
    values: wp.array2d(dtype=wp.float32),
):
    """ReLU and LayerNorm of a row, in place."""
    row = wp.tid()
    for i in range(values.shape[1]):
        values[row, i] = wp.max(values[row, i], 0.0)
    normalise(row, scale, shift, epsilon, values)
