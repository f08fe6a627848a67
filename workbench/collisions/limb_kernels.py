# pyright: basic, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
"""Warp kernels of the corrective, one frame: what its patches see, and what they do.  See `limb_sight`."""

import warp as wp

from workbench.collisions.network_kernels import normalise

wp.set_module_options({"enable_backward": False})


@wp.kernel
def see_limbs(
    anchors: wp.array(dtype=wp.vec3),
    weights: wp.array2d(dtype=wp.float32),
    transforms: wp.array2d(dtype=wp.float32),
    world: wp.array(dtype=wp.mat33),
    places: wp.array(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    ends: wp.array(dtype=wp.int32),
    far: float,
    features: wp.array2d(dtype=wp.float32),
):
    """Of one patch, every bone.  `world` and `places`: how joints are turned and where they are."""
    patch = wp.tid()
    a_bone = features.shape[1] // starts.shape[0]
    A = wp.mat33(0.0)
    t = wp.vec3(0.0, 0.0, 0.0)
    for j in range(weights.shape[1]):
        weight = weights[patch, j]
        if weight != 0.0:
            A += weight * world[j]
            t += weight * wp.vec3(transforms[j, 3], transforms[j, 7], transforms[j, 11])
    place = A * anchors[patch] + t
    to_own = wp.transpose(A)
    for bone in range(starts.shape[0]):
        first = places[starts[bone]]
        along = places[ends[bone]] - first
        to = place - first
        share = wp.clamp(wp.dot(to, along) / wp.dot(along, along), 0.0, 1.0)
        apart = share * along - to
        near = wp.exp(-0.5 * wp.dot(apart, apart) / (far * far))
        seen = to_own * apart
        turn = to_own * world[starts[bone]]
        at = a_bone * bone
        features[patch, at] = near
        for i in range(3):
            features[patch, at + 1 + i] = near * seen[i] / far
            for k in range(3):
                features[patch, at + 4 + 3 * i + k] = near * (turn[i, k] - wp.where(i == k, 1.0, 0.0))


# A block of a patch: for each of its amounts, its factors for 16 outputs.  See `network_kernels`.
_PATCH_BLOCK = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    typedef _Float16 halves __attribute__((vector_size(32), aligned(2)));
    const int rank = amounts.shape[1];
    const halves* factor = reinterpret_cast<const halves*>(blocks.data) + size_t(block) * rank;
    const float* amount = amounts.data + size_t(block / blocks_a_patch) * rank;
    lanes sum[2] = {};
    int k = 0;
    for (; k + 2 <= rank; k += 2)
        for (int i = 0; i < 2; ++i) sum[i] += amount[k + i] * __builtin_convertvector(factor[k + i], lanes);
    for (; k < rank; ++k) sum[0] += amount[k] * __builtin_convertvector(factor[k], lanes);
    reinterpret_cast<lanes*>(values.data)[block] = sum[0] + sum[1];
"""


@wp.func_native(_PATCH_BLOCK)
def patch_block(
    block: int,
    blocks_a_patch: int,
    blocks: wp.array(dtype=wp.float16),
    amounts: wp.array2d(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def mix_patches(
    blocks_a_patch: int,
    blocks: wp.array(dtype=wp.float16),
    amounts: wp.array2d(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
):
    """Each patch's amounts of its own basis; values in whole blocks of LANES."""
    patch_block(wp.tid(), blocks_a_patch, blocks, amounts, values)


@wp.kernel
def spread_patches(
    begins: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.int32),
    windows: wp.array(dtype=wp.float32),
    values: wp.array(dtype=wp.float32),
    offsets: wp.array(dtype=wp.vec3),
):
    """Of each vertex, what its patches say, weighted: entries begins[n] to begins[n + 1] of `places` and `windows`."""
    n = wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(begins[n], begins[n + 1]):
        place = places[k]
        total += windows[k] * wp.vec3(values[place], values[place + 1], values[place + 2])
    offsets[n] = total


_ADD_AND_RECTIFY = """
    const int size = values.shape[1];
    float* const value = values.data + size_t(row) * size;
    const float* const of_all = common.data;
    const float* const of_it = own.data + size_t(row) * size;
    #pragma clang loop vectorize(assume_safety)
    for (int i = 0; i < size; ++i) {
        const float sum = value[i] + of_all[i] + of_it[i];
        value[i] = sum > 0 ? sum : 0;
    }
"""


@wp.func_native(_ADD_AND_RECTIFY)
def add_and_rectify(
    row: int,
    common: wp.array(dtype=wp.float32),
    own: wp.array2d(dtype=wp.float32),
    values: wp.array2d(dtype=wp.float32),
): ...


@wp.kernel
def add_rectify_and_normalise(
    common: wp.array(dtype=wp.float32),
    own: wp.array2d(dtype=wp.float32),
    scale: wp.array(dtype=wp.float32),
    shift: wp.array(dtype=wp.float32),
    epsilon: float,
    values: wp.array2d(dtype=wp.float32),
):
    """Of one patch: what all patches and what it alone has is added; ReLU and LayerNorm, in place."""
    row = wp.tid()
    add_and_rectify(row, common, own, values)
    normalise(row, scale, shift, epsilon, values)
