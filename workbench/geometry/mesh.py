"""Triangle meshes: what makes one usable, and what every stage measures on it.  vertices (V,3), faces (F,3) -> facts.

A garment must be ONE orientable manifold sheet with its normals pointing away from the body; `require_sheet` says in
one line what is wrong with any other mesh.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from workbench.geometry.closest_point import ClosestPoint


@dataclass(frozen=True)
class Topology:
    """What connects to what. An edge is a pair of vertices, smaller index first."""

    edges: Int[Tensor, "E 2"]
    edge_face_count: Int[Tensor, " E"]  # 1 on a boundary, 2 inside, more where the mesh is not manifold
    part_of_vertex: Int[Tensor, " V"]  # connected part of each vertex; a vertex without a face is its own part
    parts: int  # parts that have at least one face
    unused_vertices: Int[Tensor, " U"]  # vertices of no face
    pinched_vertices: Int[Tensor, " P"]  # vertices whose faces form more than one fan
    repeated_edges: int  # edges that two faces walk in the SAME direction: neighbours disagree about the outside
    degenerate_faces: Int[Tensor, " D"]  # faces that name a vertex twice

    @property
    def boundary_edges(self) -> Int[Tensor, "K 2"]:
        return self.edges[self.edge_face_count == 1]

    @property
    def closed(self) -> bool:
        return bool((self.edge_face_count == 2).all())

    @property
    def manifold(self) -> bool:
        return bool((self.edge_face_count <= 2).all()) and len(self.pinched_vertices) == 0

    @property
    def oriented(self) -> bool:
        return self.repeated_edges == 0


def half_edges(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "H 2"]:
    """Directed edges in face order: first all (0,1), then all (1,2), then all (2,0)."""
    return torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


@dataclass(frozen=True)
class UniquePairs:
    pairs: Int[Tensor, "E 2"]  # sorted
    which: Int[Tensor, " H"]  # the unique pair that each given pair is
    count: Int[Tensor, " E"]


def unique_pairs(pairs: Int[Tensor, "H 2"]) -> UniquePairs:
    """Distinct pairs of indices. One key a pair, because torch.unique(dim=0) is slow."""
    base = int(pairs.max()) + 1 if len(pairs) else 1
    keys, which, count = torch.unique(pairs[:, 0] * base + pairs[:, 1], return_inverse=True, return_counts=True)
    return UniquePairs(torch.stack([keys // base, keys % base], 1), which, count)


def unique_edges(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "E 2"]:
    """Undirected edges, smaller index first, sorted."""
    return unique_pairs(half_edges(faces).sort(1).values).pairs


def inspect_topology(faces: Int[Tensor, "F 3"], vertex_count: int) -> Topology:
    """All combinatorial facts of a mesh at once.

    Raises:
        ValueError: a face index is out of range, or there is no face.
    """
    if len(faces) == 0:
        raise ValueError("the mesh has no faces; expected at least one triangle")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= vertex_count:
        raise ValueError(f"faces index vertex {low if low < 0 else high}, but the mesh has {vertex_count} vertices")
    directed = half_edges(faces)
    undirected = unique_pairs(directed.sort(1).values)
    edges, edge_of_half, count = undirected.pairs, undirected.which, undirected.count
    times_walked = unique_pairs(directed).count
    used = torch.zeros(vertex_count, dtype=torch.bool)
    used[faces.reshape(-1)] = True
    degenerate = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    part = _components(edges.numpy(), vertex_count)
    return Topology(
        edges=edges,
        edge_face_count=count,
        part_of_vertex=torch.from_numpy(part),
        parts=len(np.unique(part[used.numpy()])),
        unused_vertices=torch.nonzero(~used)[:, 0],
        pinched_vertices=_pinched_vertices(faces, edge_of_half, vertex_count),
        repeated_edges=int((times_walked > 1).sum()),
        degenerate_faces=torch.nonzero(degenerate)[:, 0],
    )


def _components(pairs: np.ndarray, count: int) -> np.ndarray:
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _pinched_vertices(
    faces: Int[Tensor, "F 3"], edge_of_half: Int[Tensor, " H"], vertex_count: int
) -> Int[Tensor, " P"]:
    """Vertices whose face corners, joined across shared edges, fall into more than one fan."""
    count = len(faces)
    corner = torch.arange(3 * count).reshape(3, count)  # corner (k, f) is vertex faces[f, k]
    tail, head = corner.reshape(-1), corner[[1, 2, 0]].reshape(-1)  # the two corners of each half edge
    flip = faces.T.reshape(-1)[tail] > faces.T.reshape(-1)[head]
    low, high = torch.where(flip, head, tail), torch.where(flip, tail, head)  # corners at the smaller, larger vertex
    order = torch.argsort(edge_of_half, stable=True)
    same = edge_of_half[order][1:] == edge_of_half[order][:-1]  # consecutive half edges of one edge
    first, second = order[:-1][same], order[1:][same]
    pairs = torch.cat([torch.stack([low[first], low[second]], 1), torch.stack([high[first], high[second]], 1)])
    fan = _components(pairs.numpy(), 3 * count)
    fans = unique_pairs(torch.stack([faces.T.reshape(-1), torch.from_numpy(fan)], 1)).pairs
    return torch.nonzero(torch.bincount(fans[:, 0], minlength=vertex_count) > 1)[:, 0]


def boundary_loops(faces: Int[Tensor, "F 3"]) -> tuple[Int[Tensor, " L"], ...]:
    """Closed chains of boundary vertices, longest first, each walked in the direction of its faces.

    Raises:
        ValueError: a boundary vertex is where two loops touch (the mesh is pinched there).
    """
    directed = half_edges(faces)
    undirected = unique_pairs(directed.sort(1).values)
    border = directed[undirected.count[undirected.which] == 1].tolist()
    following = dict(border)
    if len(following) < len(border):
        raise ValueError("two boundary loops touch in one vertex; split that vertex first")
    loops: list[list[int]] = []
    while following:
        start, vertex = following.popitem()
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        turn = loop.index(min(loop))  # a fixed start, so that the same mesh always gives the same loop
        loops.append(loop[turn:] + loop[:turn])
    return tuple(torch.tensor(loop) for loop in sorted(loops, key=lambda loop: (-len(loop), loop[0])))


def require_sheet(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], name: str = "mesh") -> Topology:
    """The topology of a finite, manifold, consistently oriented mesh of one part; anything else is refused.

    Raises:
        ValueError: NaN or infinite coordinates, bad indices, degenerate faces, unused vertices, non-manifold edges or
            vertices, disagreeing orientation, or several parts: the first of these, in one line.
    """
    finite = torch.isfinite(vertices).all(1)
    if not bool(finite.all()):
        bad = torch.nonzero(~finite)[:, 0]
        raise ValueError(f"{name}: {len(bad)} of {len(vertices)} vertices are NaN or infinite (first: {int(bad[0])})")
    topology = inspect_topology(faces, len(vertices))
    if len(topology.degenerate_faces):
        count, first = len(topology.degenerate_faces), int(topology.degenerate_faces[0])
        raise ValueError(f"{name}: {count} faces name a vertex twice (first: face {first}); remove them")
    if len(topology.unused_vertices):
        raise ValueError(f"{name}: {len(topology.unused_vertices)} vertices belong to no face; remove them")
    crowded = topology.edges[topology.edge_face_count > 2]
    if len(crowded):
        pair = tuple(crowded[0].tolist())
        raise ValueError(f"{name}: {len(crowded)} edges have more than two faces (first: {pair}): not a manifold sheet")
    if len(topology.pinched_vertices):
        count, first = len(topology.pinched_vertices), int(topology.pinched_vertices[0])
        raise ValueError(f"{name}: {count} vertices join sheets that share no edge (first: {first}): not a manifold")
    if not topology.oriented:
        raise ValueError(
            f"{name}: {topology.repeated_edges} edges lie between faces of opposite orientation; make it consistent"
        )
    if topology.parts > 1:
        raise ValueError(f"{name}: expected one connected part, got {topology.parts}; keep one or join them")
    return topology


def outward_share(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    body_vertices: Float[Tensor, "U 3"],
    body_faces: Int[Tensor, "G 3"],
) -> float:
    """Share of the garment's area whose normal points away from the closest body point; below 0.5 is inside out."""
    centres = vertices[faces].mean(1)
    closest = ClosestPoint(body_vertices.numpy(), body_faces.numpy()).query(centres.numpy())
    away = centres - torch.as_tensor(closest.point, dtype=centres.dtype)
    area = face_areas(vertices, faces)
    return float((area * ((face_normals(vertices, faces) * away).sum(1) > 0)).sum() / area.sum())


def face_areas(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B F"]:
    return 0.5 * _face_cross(vertices, faces).norm(dim=-1)


def face_normals(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B F 3"]:
    """Unit normals, counter-clockwise faces outwards; zero for a face without area."""
    return torch.nn.functional.normalize(_face_cross(vertices, faces), dim=-1, eps=1e-20)


def vertex_normals(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B V 3"]:
    """Unit normals: the area-weighted sum of the faces around each vertex."""
    total = torch.zeros_like(vertices)
    cross = _face_cross(vertices, faces)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], cross)
    return torch.nn.functional.normalize(total, dim=-1, eps=1e-20)


def vertex_areas(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B V"]:
    """A third of each adjacent face (barycentric areas); they sum to the area of the mesh."""
    area = face_areas(vertices, faces) / 3
    total = area.new_zeros(vertices.shape[:-1])
    for corner in range(3):
        total = total.index_add(-1, faces[:, corner], area)
    return total


def edge_lengths(vertices: Float[Tensor, "*B V 3"], edges: Int[Tensor, "E 2"]) -> Float[Tensor, "*B E"]:
    return (vertices[..., edges[:, 0], :] - vertices[..., edges[:, 1], :]).norm(dim=-1)


def enclosed_volume(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B"]:
    """Signed volume of a closed mesh [m^3]; negative when its normals point inwards."""
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    return (a * torch.linalg.cross(b, c)).sum((-1, -2)) / 6


def _face_cross(vertices: Float[Tensor, "*B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*B F 3"]:
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    return torch.linalg.cross(b - a, c - a)


@dataclass(frozen=True)
class QuadMesh:
    vertices: Float[Tensor, "V 3"]
    quads: Int[Tensor, "Q 4"]


def subdivide_quads(mesh: QuadMesh) -> QuadMesh:
    """Each quad into four at edge midpoints and centroid (linear: no vertex moves, winding is kept)."""
    vertices, quads = mesh.vertices, mesh.quads
    sides = torch.cat([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    unique = unique_pairs(sides.sort(1).values)
    edges, side_edge = unique.pairs, unique.which
    count = len(vertices)
    middle = (count + side_edge).reshape(4, len(quads)).T  # (Q,4): middle of the side that starts at corner i
    centre = count + len(edges) + torch.arange(len(quads))
    grown = torch.cat([vertices, vertices[edges].mean(1), vertices[quads].mean(1)])
    children = [torch.stack([quads[:, i], middle[:, i], centre, middle[:, i - 1]], 1) for i in range(4)]
    return QuadMesh(grown, torch.stack(children, 1).reshape(-1, 4))


def triangulate(mesh: QuadMesh) -> Int[Tensor, "F 3"]:
    """Each quad cut along its shorter diagonal, winding kept."""
    a, b, c, d = mesh.quads.T
    first = (mesh.vertices[a] - mesh.vertices[c]).norm(dim=1) <= (mesh.vertices[b] - mesh.vertices[d]).norm(dim=1)
    one = torch.where(first[:, None], torch.stack([a, b, c], 1), torch.stack([a, b, d], 1))
    two = torch.where(first[:, None], torch.stack([a, c, d], 1), torch.stack([b, c, d], 1))
    return torch.stack([one, two], 1).reshape(-1, 3)
