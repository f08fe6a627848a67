# pyright: basic, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportReturnType=false
"""Warp kernels of one posed frame (Eq. 7-8): skeleton, leaf cells, rows, points.  Compiled at first use, then cached.

On the CPU the items of a launch come one after the other, so that each can fetch what a later one reads.
"""

import warp as wp

LANES = 16  # floats a chunk: one cache line
SUMS = 4  # a row has a multiple of so many weights, some of them 0
SOME = 8  # points that look for their leaves together
AHEAD = wp.constant(4)  # points; what is read then is on its way while a point is worked on
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


# In C++, as the others below: a point's way down a tree is a chain of reads, so that some points go side by side.
_LEAVES_OF_SOME = """
    const int first = SOME * block, points_left = order.shape[0] - first;
    const int count = points_left < SOME ? points_left : SOME;
    const int* down = child.data;
    float u[SOME][3];
    int cell[SOME];
    for (int p = 0; p < count; ++p) {
        const wp::vec3 x = (points.data[order.data[first + p]] - low) / root_size;
        cell[p] = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const float most = (float)shape[axis];
            const float clamped = x[axis] < 0 ? 0 : x[axis] > most ? most : x[axis];
            const int whole = (int)clamped < shape[axis] - 1 ? (int)clamped : shape[axis] - 1;
            u[p][axis] = clamped - (float)whole;
            cell[p] = cell[p] * shape[axis] + whole;
        }
        __builtin_prefetch(down + cell[p]);
    }
    for (bool split = true; split;) {
        split = false;
        for (int p = 0; p < count; ++p) {
            const int begin = down[cell[p]];
            if (begin < 0) continue;
            int octant = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const float doubled = 2 * u[p][axis];
                const int upper = (int)doubled < 1 ? (int)doubled : 1;
                u[p][axis] = doubled - (float)upper;
                octant = 2 * octant + upper;
            }
            cell[p] = begin + octant;
            __builtin_prefetch(down + cell[p]);
            split = true;
        }
    }
    for (int p = 0; p < count; ++p) {
        local.data[first + p] = wp::vec3(u[p][0], u[p][1], u[p][2]);
        leaf.data[first + p] = down[cell[p]] == -1 ? -1 - cell[p] : -2 - down[cell[p]];
    }
"""


@wp.func_native(_LEAVES_OF_SOME.replace("SOME", str(SOME)))
def leaves_of_some(
    block: int,
    order: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    root_size: float,
    shape: wp.vec3i,
    child: wp.array(dtype=wp.int32),
    leaf: wp.array(dtype=wp.int32),
    local: wp.array(dtype=wp.vec3),
): ...


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
    to the box; an item for every SOME of them.

    `child` holds the first child of a split cell, -2 - number of a leaf, or -1 for a leaf that has no number yet;
    for such a leaf the result is -1 - cell."""
    leaves_of_some(wp.tid(), order, points, low, root_size, shape, child, leaf, local)


_MARK_ROWS = """
    const int* corner = corners.data;
    __builtin_prefetch(corner + 8 * later);
    for (int k = 0; k < 8; ++k) asked.data[corner[8 * cell + k]] = frame;
"""


@wp.func_native(_MARK_ROWS)
def marked_rows(
    cell: int, later: int, frame: int, corners: wp.array2d(dtype=wp.int32), asked: wp.array(dtype=wp.int32)
): ...


@wp.kernel
def mark_rows(
    leaf: wp.array(dtype=wp.int32),
    corners: wp.array2d(dtype=wp.int32),
    frame: wp.array(dtype=wp.int32),
    asked: wp.array(dtype=wp.int32),
):
    """Note the frame at every row that one of its points blends."""
    i = wp.tid()
    marked_rows(leaf[i], leaf[wp.min(i + AHEAD, leaf.shape[0] - 1)], frame[0], corners, asked)


# In C++, with the compiler's vector type: the same loops in Warp's Python took four times as long.
_BLEND_ROWS = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    typedef short codes __attribute__((vector_size(32), aligned(2)));
    typedef float quad __attribute__((vector_size(16), aligned(4)));
    const int rows = asked.shape[0], chunks = offsets.shape[1] / 16;
    const lanes* joint = reinterpret_cast<const lanes*>(transforms.data);
    const lanes* factor = reinterpret_cast<const lanes*>(factors.data);
    for (size_t row = 0; row < rows; ++row) {
        const size_t later = row + 8;  // on its way while this one is worked on
        if (later < rows && asked.data[later] == frame) {
            const short* of_later = offsets.data + 16 * later * chunks;
            __builtin_prefetch(weights.data + begins.data[later]);
            __builtin_prefetch(carriers.data + begins.data[later]);
            for (int chunk = 0; chunk < chunks; chunk += 2) __builtin_prefetch(of_later + 16 * chunk);
        }
        if (asked.data[row] != frame) continue;
        const codes* code = reinterpret_cast<const codes*>(offsets.data + 16 * row * chunks);
        lanes part[SUMS] = {};  // so that additions need not wait for each other
        for (int k = begins.data[row]; k < begins.data[row + 1]; k += SUMS)
            for (int i = 0; i < SUMS; ++i) part[i] += weights.data[k + i] * joint[carriers.data[k + i]];
        lanes offset = {};
        for (int chunk = 0; chunk < chunks; ++chunk)
            offset += __builtin_convertvector(code[chunk], lanes) * factor[chunk];
        float triples[16];
        __builtin_memcpy(triples, &offset, sizeof(offset));
        quad moved = {};
        for (int triple = 0; triple < 5; ++triple) moved += *reinterpret_cast<const quad*>(triples + 3 * triple);
        float* map = maps.data + 16 * row;
        *reinterpret_cast<lanes*>(map) = (part[0] + part[1]) + (part[2] + part[3]);
        *reinterpret_cast<quad*>(map + 12) = moved;
    }
"""


@wp.func_native(_BLEND_ROWS.replace("SUMS", str(SUMS)))
def blended_rows(
    frame: int,
    asked: wp.array(dtype=wp.int32),
    begins: wp.array(dtype=wp.int32),
    carriers: wp.array(dtype=wp.uint16),
    weights: wp.array(dtype=wp.float32),
    offsets: wp.array2d(dtype=wp.int16),
    transforms: wp.array2d(dtype=wp.float32),
    factors: wp.array(dtype=wp.float32),
    maps: wp.array2d(dtype=wp.float32),
): ...


@wp.kernel
def blend_rows(
    frame: wp.array(dtype=wp.int32),
    asked: wp.array(dtype=wp.int32),
    begins: wp.array(dtype=wp.int32),
    carriers: wp.array(dtype=wp.uint16),
    weights: wp.array(dtype=wp.float32),
    offsets: wp.array2d(dtype=wp.int16),
    transforms: wp.array2d(dtype=wp.float32),
    factors: wp.array(dtype=wp.float32),
    maps: wp.array2d(dtype=wp.float32),
):
    """The maps of the rows that this frame asks for: sum_j W~_j T_j as (R | t), then B~s + B~p.  One item.

    A row: the joints that carry it and how much, from begins[row] to begins[row + 1]; displacements as integers in
    chunks of TRIPLES; `factors` has what each displacement's integers are multiplied with, three times, and 0 for what
    is to spare.  Rows are read in the order in which they lie."""
    blended_rows(frame[0], asked, begins, carriers, weights, offsets, transforms, factors, maps)


_POSED_POINT = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    for (int k = 0; k < 8; ++k) __builtin_prefetch(maps.data + 16 * size_t(corners.data[8 * later + k]));
    lanes map = {};
    for (int k = 0; k < 8; ++k) {
        const float share = (k & 4 ? u[0] : 1 - u[0]) * (k & 2 ? u[1] : 1 - u[1]) * (k & 1 ? u[2] : 1 - u[2]);
        map += share * reinterpret_cast<const lanes*>(maps.data)[corners.data[8 * cell + k]];
    }
    float moved[3];
    for (int i = 0; i < 3; ++i) moved[i] = X[i] + map[12 + i];
    wp::vec3 posed;
    for (int i = 0; i < 3; ++i)
        posed[i] = map[4 * i] * moved[0] + map[4 * i + 1] * moved[1] + map[4 * i + 2] * moved[2] + map[4 * i + 3];
    return posed;
"""


@wp.func_native(_POSED_POINT)
def posed_point(
    X: wp.vec3,
    u: wp.vec3,
    cell: int,
    later: int,
    corners: wp.array2d(dtype=wp.int32),
    maps: wp.array2d(dtype=wp.float32),
) -> wp.vec3: ...


@wp.kernel
def pose_points(
    order: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    local: wp.array(dtype=wp.vec3),
    leaf: wp.array(dtype=wp.int32),
    corners: wp.array2d(dtype=wp.int32),
    maps: wp.array2d(dtype=wp.float32),
    posed: wp.array(dtype=wp.vec3),
):
    """M_G = (sum_j W~_j T_j) (X + B~s + B~p)      (Eq. 7-8), both factors interpolated between the leaf's corners.

    Both are linear in the fields, so that it does not matter that rows were blended before; there are half as many
    rows as corners of all points."""
    i = wp.tid()
    n = order[i]
    posed[n] = posed_point(points[n], local[i], leaf[i], leaf[wp.min(i + AHEAD, leaf.shape[0] - 1)], corners, maps)
