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


@wp.func
def is_positive(value: wp.float64, slope: wp.vec3d):
    """value > 0, where zero counts as what it becomes when something moves by (eps, eps^2, eps^3); `slope` is the
    value's derivative by that move.  So all tests break ties alike, and no way runs along an edge or a corner."""
    zero = wp.float64(0.0)
    if value == zero:
        value = slope[0]
        if value == zero:
            value = slope[1]
            if value == zero:
                value = slope[2]
    return value > zero


@wp.func
def volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Six times the signed volume of a tetrahedron: positive where d is on the side that the normal of a b c shows."""
    return wp.dot(wp.cross(b - a, c - a), d - a)


@wp.func
def passes_left(a: wp.vec3d, b: wp.vec3d, ia: int, ib: int, p: wp.vec3d, q: wp.vec3d, ip: int, iq: int):
    """On which side the sheet's edge a b passes the mesh's edge p q.  Ends are taken by index, so that faces that share
    an edge agree to the last bit and no crossing slips between them."""
    s = a
    t = b
    if ib < ia:
        s = b
        t = a
    u = p
    w = q
    if iq < ip:
        u = q
        w = p
    return is_positive(volume(s, t, u, w), wp.cross(t - s, w - u)) != ((ib < ia) != (iq < ip))


@wp.func
def is_left(a: wp.vec3d, b: wp.vec3d, p: wp.vec3d, axis: wp.vec3d):
    """On which side of the line from a to b the point p is, seen along `axis`.  The ends are taken in one order, for
    the same reason."""
    s = a
    t = b
    turned = b[0] < a[0] or (b[0] == a[0] and (b[1] < a[1] or (b[1] == a[1] and b[2] < a[2])))
    if turned:
        s = b
        t = a
    sideways = wp.cross(axis, t - s)
    return is_positive(wp.dot(sideways, p - s), sideways) != turned


@wp.kernel
def count_layers(
    mesh: wp.uint64,
    start: int,
    points: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
    vertices: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.int32),
    low: wp.vec3,
    high: wp.vec3,
    layers: wp.array(dtype=wp.int32),
):
    """The winding number of a closed mesh as a whole number: faces left minus faces entered on the shortest way out of
    its box (low, high).  Single-precision positions, tests in double precision; in ties the point counts as moved by
    (eps, eps^2, eps^3)."""
    i = index[start + wp.tid()]
    p = points[i]
    d = int(0)  # noqa: UP018  a variable for Warp, not a constant
    end = float(0.0)  # noqa: UP018
    upwards = bool(True)  # noqa: UP018
    room = float(1.0e30)  # noqa: UP018
    for k in range(3):
        if high[k] - p[k] < room:
            room = high[k] - p[k]
            d = k
            end = high[k]
            upwards = bool(True)  # noqa: UP018
        if p[k] - low[k] < room:
            room = p[k] - low[k]
            d = k
            end = low[k]
            upwards = bool(False)  # noqa: UP018
    way_out = p
    way_out[d] = end
    axis = wp.vec3d(wp.float64(0.0))
    axis[d] = wp.float64(1.0)
    q = wp.vec3d(p)
    count = int(0)  # noqa: UP018
    f = int(0)  # noqa: UP018
    query = wp.mesh_query_aabb(mesh, wp.min(p, way_out), wp.max(p, way_out))
    while wp.mesh_query_aabb_next(query, f):
        a = wp.vec3d(vertices[corners[3 * f]])
        b = wp.vec3d(vertices[corners[3 * f + 1]])
        c = wp.vec3d(vertices[corners[3 * f + 2]])
        left = is_left(a, b, q, axis)
        if left == is_left(b, c, q, axis) and left == is_left(c, a, q, axis):
            # `left`: the face's normal points along the axis
            beyond = is_positive(volume(a, b, c, q), wp.cross(b - a, c - a)) == left
            if beyond != upwards:
                count += wp.where(left == upwards, 1, -1)
    layers[i] = count


@wp.kernel
def surface_crossings(
    mesh: wp.uint64,
    start: int,
    sheet: wp.array(dtype=wp.vec3),
    sheet_corners: wp.array2d(dtype=wp.int32),
    vertices: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.int32),
    outwards: bool,
    crossed: wp.array2d(dtype=wp.uint8),
    pierced: wp.array(dtype=wp.uint8),
    poking: wp.array(dtype=wp.uint8),
):
    """For the faces start, start + 1, ... of a sheet against all of the mesh: which of its edges (0,1), (1,2), (2,0)
    cross the mesh; whether an edge of the mesh crosses it; the ends of such edges on its outer side (the side of its
    normal, or with `outwards` false the other).  In ties the sheet counts as moved by (eps, eps^2, eps^3)."""
    g = start + wp.tid()
    ia = sheet_corners[g, 0]
    ib = sheet_corners[g, 1]
    ic = sheet_corners[g, 2]
    a = wp.vec3d(sheet[ia])
    b = wp.vec3d(sheet[ib])
    c = wp.vec3d(sheet[ic])
    sheet_normal = wp.cross(b - a, c - a)
    low = wp.min(wp.min(sheet[ia], sheet[ib]), sheet[ic])
    high = wp.max(wp.max(sheet[ia], sheet[ib]), sheet[ic])
    f = int(0)  # noqa: UP018
    query = wp.mesh_query_aabb(mesh, low, high)
    while wp.mesh_query_aabb_next(query, f):
        ip = corners[3 * f]
        iq = corners[3 * f + 1]
        ir = corners[3 * f + 2]
        p = wp.vec3d(vertices[ip])
        q = wp.vec3d(vertices[iq])
        r = wp.vec3d(vertices[ir])
        mesh_normal = wp.cross(q - p, r - p)
        a_above = is_positive(volume(p, q, r, a), mesh_normal)
        b_above = is_positive(volume(p, q, r, b), mesh_normal)
        c_above = is_positive(volume(p, q, r, c), mesh_normal)
        p_above = is_positive(volume(a, b, c, p), -sheet_normal)
        q_above = is_positive(volume(a, b, c, q), -sheet_normal)
        r_above = is_positive(volume(a, b, c, r), -sheet_normal)
        apart = (a_above == b_above and b_above == c_above) or (p_above == q_above and q_above == r_above)
        if not apart:
            ab_pq = passes_left(a, b, ia, ib, p, q, ip, iq)
            ab_qr = passes_left(a, b, ia, ib, q, r, iq, ir)
            ab_rp = passes_left(a, b, ia, ib, r, p, ir, ip)
            bc_pq = passes_left(b, c, ib, ic, p, q, ip, iq)
            bc_qr = passes_left(b, c, ib, ic, q, r, iq, ir)
            bc_rp = passes_left(b, c, ib, ic, r, p, ir, ip)
            ca_pq = passes_left(c, a, ic, ia, p, q, ip, iq)
            ca_qr = passes_left(c, a, ic, ia, q, r, iq, ir)
            ca_rp = passes_left(c, a, ic, ia, r, p, ir, ip)
            if a_above != b_above and ab_pq == ab_qr and ab_qr == ab_rp:
                crossed[g, 0] = wp.uint8(1)
            if b_above != c_above and bc_pq == bc_qr and bc_qr == bc_rp:
                crossed[g, 1] = wp.uint8(1)
            if c_above != a_above and ca_pq == ca_qr and ca_qr == ca_rp:
                crossed[g, 2] = wp.uint8(1)
            if p_above != q_above and ab_pq == bc_pq and bc_pq == ca_pq:
                pierced[g] = wp.uint8(1)
                poking[wp.where(p_above == outwards, ip, iq)] = wp.uint8(1)
            if q_above != r_above and ab_qr == bc_qr and bc_qr == ca_qr:
                pierced[g] = wp.uint8(1)
                poking[wp.where(q_above == outwards, iq, ir)] = wp.uint8(1)
            if r_above != p_above and ab_rp == bc_rp and bc_rp == ca_rp:
                pierced[g] = wp.uint8(1)
                poking[wp.where(r_above == outwards, ir, ip)] = wp.uint8(1)
