# pyright: basic, reportAttributeAccessIssue=false, reportOperatorIssue=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
"""Warp kernels of the geometry: one row of the output a thread.  Compiled at first use, cached by Warp afterwards."""

import os

import warp as wp


def _initialise_quietly() -> None:
    """Start Warp without its greeting and without its (native, unconditional) stderr line about a missing GPU driver:
    the command line promises one clear line on stderr, and a CPU is all that is asked for here."""
    wp.config.log_level = wp.LOG_ERROR
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        wp.init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
    wp.config.log_level = wp.LOG_WARNING


_initialise_quietly()
wp.set_module_options({"enable_backward": False})


@wp.kernel
def closest_points(
    mesh: wp.uint64,
    start: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.vec3),
    closest: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=wp.float32),
):
    """phi of Eq. 4-6 for the points order[start], order[start + 1], ..."""
    i = order[start + wp.tid()]
    p = points[i]
    hit = wp.mesh_query_point_no_sign(mesh, p, 1.0e6)
    q = wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
    face[i] = hit.face
    barycentric[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
    closest[i] = q
    distance[i] = wp.length(q - p)


@wp.kernel
def sum_solid_angles(
    start: int,
    points: wp.array(dtype=wp.vec3),
    corners: wp.array2d(dtype=wp.vec3),
    winding: wp.array(dtype=wp.float64),
):
    """Sum of the signed solid angles of all faces over 4 pi, in double precision."""
    i = start + wp.tid()
    p = wp.vec3d(points[i])
    half = wp.float64(0.0)
    for f in range(corners.shape[0]):
        a = wp.vec3d(corners[f, 0]) - p
        b = wp.vec3d(corners[f, 1]) - p
        c = wp.vec3d(corners[f, 2]) - p
        la = wp.length(a)
        lb = wp.length(b)
        lc = wp.length(c)
        volume = wp.dot(a, wp.cross(b, c))
        base = la * lb * lc + wp.dot(a, b) * lc + wp.dot(b, c) * la + wp.dot(c, a) * lb
        half += wp.atan2(volume, base)
    winding[i] = half / wp.float64(6.283185307179586)


@wp.kernel
def winding_verdict(
    mesh: wp.uint64,
    start: int,
    points: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
    low: float,
    high: float,
    accuracy: float,
    verdict: wp.array(dtype=wp.int32),
):
    """0 where the fast winding number is below `low`, 1 above `high`, 2 between: Warp tells only on which side of a
    threshold it is, hence two questions."""
    i = index[start + wp.tid()]
    p = points[i]
    above_low = wp.mesh_query_point_sign_winding_number(mesh, p, 1.0e6, accuracy, low)
    result = int(0)  # noqa: UP018  a variable for Warp, not a constant
    if above_low.sign < 0.0:
        above_high = wp.mesh_query_point_sign_winding_number(mesh, p, 1.0e6, accuracy, high)
        result = int(2)  # noqa: UP018
        if above_high.sign < 0.0:
            result = int(1)  # noqa: UP018
    verdict[i] = result


@wp.kernel
def gaussian_neighbours(
    mesh: wp.uint64,
    start: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=wp.int32),
    directions: wp.array(dtype=wp.vec3),
    least_sigma: float,
    face: wp.array2d(dtype=wp.int32),
    barycentric: wp.array2d(dtype=wp.vec3),
    surface_face: wp.array(dtype=wp.int32),
    surface_barycentric: wp.array(dtype=wp.vec3),
    away: wp.array(dtype=wp.vec3),
):
    """phi(q_n) for q_n = p + sigma g_n with sigma = max(d, least_sigma) (Eq. 4-6), and phi(p), p - phi(p) beside."""
    i = order[start + wp.tid()]
    p = points[i]
    own = wp.mesh_query_point_no_sign(mesh, p, 1.0e6)
    offset = p - wp.mesh_eval_position(mesh, own.face, own.u, own.v)
    surface_face[i] = own.face
    surface_barycentric[i] = wp.vec3(own.u, own.v, 1.0 - own.u - own.v)
    away[i] = offset
    sigma = wp.max(wp.length(offset), least_sigma)
    for n in range(directions.shape[0]):
        hit = wp.mesh_query_point_no_sign(mesh, p + sigma * directions[n], 1.0e6)
        face[i, n] = hit.face
        barycentric[i, n] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)


@wp.kernel
def locate_in_octree(
    start: int,
    points: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    root_size: float,
    shape: wp.vec3i,
    child: wp.array(dtype=wp.int32),
    corner: wp.array2d(dtype=wp.int32),
    nodes: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
    local: wp.array(dtype=wp.vec3),
    size: wp.array(dtype=wp.float32),
):
    """The corner nodes of the leaf cell that holds each point (clamped to the box), their trilinear weights, the local
    coordinates in [0, 1]^3 and the cell's edge."""
    n = start + wp.tid()
    x = (points[n] - low) / root_size
    u = wp.vec3(0.0, 0.0, 0.0)
    index = int(0)  # noqa: UP018
    for axis in range(3):
        clamped = wp.clamp(x[axis], 0.0, float(shape[axis]))
        i = wp.min(int(clamped), shape[axis] - 1)
        u[axis] = clamped - float(i)
        index = index * shape[axis] + i
    edge = float(root_size)
    down = child[index]
    while down >= 0:
        octant = int(0)  # noqa: UP018
        for axis in range(3):
            doubled = 2.0 * u[axis]
            i = wp.min(int(doubled), 1)
            u[axis] = doubled - float(i)
            octant = 2 * octant + i
        index = down + octant
        edge = 0.5 * edge
        down = child[index]
    for k in range(8):
        nodes[n, k] = corner[index, k]
    lx = 1.0 - u[0]
    ly = 1.0 - u[1]
    lz = 1.0 - u[2]
    weights[n, 0] = lx * ly * lz
    weights[n, 1] = lx * ly * u[2]
    weights[n, 2] = lx * u[1] * lz
    weights[n, 3] = lx * u[1] * u[2]
    weights[n, 4] = u[0] * ly * lz
    weights[n, 5] = u[0] * ly * u[2]
    weights[n, 6] = u[0] * u[1] * lz
    weights[n, 7] = u[0] * u[1] * u[2]
    local[n] = u
    size[n] = edge
