# pyright: basic, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false
"""Warp kernels of one posed frame (Eq. 7-8): skeleton, leaf cells, points.  Compiled at first use, cached by Warp."""

import warp as wp

LANES = 16  # floats a chunk: one cache line
TRIPLES = 5  # displacements (x, y, z) a chunk, one float to spare

wp.set_module_options({"enable_backward": False})


@wp.kernel
def joint_transforms(
    parents: wp.array(dtype=wp.int32),
    joints: wp.array(dtype=wp.vec3),
    rotations: wp.array(dtype=wp.mat33),
    translation: wp.array(dtype=wp.vec3),
    world: wp.array(dtype=wp.mat33),
    ends: wp.array(dtype=wp.vec3),
    transforms: wp.array2d(dtype=wp.float32),
):
    """Forward kinematics: each joint's map of rest points, rows of (R | t); a chain, hence one thread."""
    for j in range(parents.shape[0]):
        parent = parents[j]
        if parent < 0:
            world[j] = rotations[j]
            ends[j] = joints[j] + translation[0]
        else:
            world[j] = world[parent] * rotations[j]
            ends[j] = ends[parent] + world[parent] * (joints[j] - joints[parent])
        R = world[j]
        t = ends[j] - R * joints[j]
        for i in range(3):
            for k in range(3):
                transforms[j, 4 * i + k] = R[i, k]
            transforms[j, 4 * i + 3] = t[i]


@wp.kernel
def find_leaves(
    order: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    root_size: float,
    shape: wp.vec3i,
    child: wp.array(dtype=wp.int32),
    leaf: wp.array(dtype=wp.int32),
    local: wp.array(dtype=wp.vec3),
):
    """The number of the leaf cell and the local coordinates in [0, 1]^3 of the points order[0], order[1], ..., clamped
    to the box.

    `child` holds the first child of a split cell, -2 - number of a leaf, or -1 for a leaf that has no number yet;
    for such a leaf the result is -1 - cell."""
    i = wp.tid()
    x = (points[order[i]] - low) / root_size
    u = wp.vec3(0.0, 0.0, 0.0)
    index = int(0)  # noqa: UP018  a variable for Warp, not a constant
    for axis in range(3):
        clamped = wp.clamp(x[axis], 0.0, float(shape[axis]))
        whole = wp.min(int(clamped), shape[axis] - 1)
        u[axis] = clamped - float(whole)
        index = index * shape[axis] + whole
    down = child[index]
    while down >= 0:
        octant = int(0)  # noqa: UP018
        for axis in range(3):
            doubled = 2.0 * u[axis]
            upper = wp.min(int(doubled), 1)
            u[axis] = doubled - float(upper)
            octant = 2 * octant + upper
        index = down + octant
        down = child[index]
    local[i] = u
    leaf[i] = wp.where(down == -1, -1 - index, -2 - down)


# In C++, with the compiler's vector type: the same loops in Warp's Python took four times as long.  `following` is the
# leaf of the next point: its rows are on their way while this point is posed.
_POSED_POINT = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    typedef short codes __attribute__((vector_size(32), aligned(2)));
    const int weight_chunks = weights.shape[1] / 16, offset_chunks = offsets.shape[1] / 16;
    const float* weight_rows = weights.data;
    const short* offset_rows = offsets.data;
    const lanes* weight_row[8];
    const codes* offset_row[8];
    float share[8];
    for (int k = 0; k < 8; ++k) {
        const size_t node = corners.data[8 * cell + k], next = corners.data[8 * following + k];
        for (int chunk = 0; chunk < weight_chunks; ++chunk)
            __builtin_prefetch(weight_rows + 16 * (next * weight_chunks + chunk));
        for (int chunk = 0; chunk < offset_chunks; chunk += 2)
            __builtin_prefetch(offset_rows + 16 * (next * offset_chunks + chunk));
        weight_row[k] = reinterpret_cast<const lanes*>(weight_rows + 16 * node * weight_chunks);
        offset_row[k] = reinterpret_cast<const codes*>(offset_rows + 16 * node * offset_chunks);
        share[k] = (k & 4 ? u[0] : 1 - u[0]) * (k & 2 ? u[1] : 1 - u[1]) * (k & 1 ? u[2] : 1 - u[2]);
    }
    const lanes* joint = reinterpret_cast<const lanes*>(transforms.data);
    lanes blended[4] = {};  // four sums, so that additions need not wait for each other
    for (int chunk = 0; chunk < weight_chunks; ++chunk, joint += 16) {
        lanes weight = {};
        for (int k = 0; k < 8; ++k) weight += share[k] * weight_row[k][chunk];
        for (int lane = 0; lane < 16; ++lane) blended[lane % 4] += weight[lane] * joint[lane];
    }
    const lanes affine = (blended[0] + blended[1]) + (blended[2] + blended[3]);
    const lanes* factor = reinterpret_cast<const lanes*>(factors.data);
    lanes offset = {};
    for (int chunk = 0; chunk < offset_chunks; ++chunk) {
        lanes part = {};
        for (int k = 0; k < 8; ++k) part += share[k] * __builtin_convertvector(offset_row[k][chunk], lanes);
        offset += part * factor[chunk];
    }
    float moved[3];
    for (int i = 0; i < 3; ++i)
        moved[i] = X[i] + (((offset[i] + offset[i + 3]) + (offset[i + 6] + offset[i + 9])) + offset[i + 12]);
    wp::vec3 posed;
    for (int i = 0; i < 3; ++i)
        posed[i] = affine[4 * i] * moved[0] + affine[4 * i + 1] * moved[1] + affine[4 * i + 2] * moved[2]
            + affine[4 * i + 3];
    return posed;
"""


@wp.func_native(_POSED_POINT)
def posed_point(
    X: wp.vec3,
    u: wp.vec3,
    cell: int,
    following: int,
    corners: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
    offsets: wp.array2d(dtype=wp.int16),
    transforms: wp.array2d(dtype=wp.float32),
    factors: wp.array(dtype=wp.float32),
) -> wp.vec3: ...


@wp.kernel
def pose_points(
    order: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    local: wp.array(dtype=wp.vec3),
    leaf: wp.array(dtype=wp.int32),
    corners: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
    offsets: wp.array2d(dtype=wp.int16),
    transforms: wp.array2d(dtype=wp.float32),
    factors: wp.array(dtype=wp.float32),
    posed: wp.array(dtype=wp.vec3),
):
    """M_G = (sum_j W~_j T_j) (X + B~s + B~p)      (Eq. 7-8), fields interpolated between the corners of the leaf.

    A node's row: weights in whole chunks of LANES, and displacements as integers in chunks of TRIPLES; `factors` has
    what each displacement's integers are multiplied with, three times, and 0 for what is to spare."""
    i = wp.tid()
    n = order[i]
    posed[n] = posed_point(
        points[n],
        local[i],
        leaf[i],
        leaf[wp.min(i + 1, order.shape[0] - 1)],
        corners,
        weights,
        offsets,
        transforms,
        factors,
    )
