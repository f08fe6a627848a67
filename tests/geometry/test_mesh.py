"""Laws of workbench.geometry.mesh, on meshes whose facts are known and on planted bad ones."""

import math

import pytest
import torch
import trimesh

from workbench.geometry.mesh import (
    QuadMesh,
    boundary_loops,
    edge_lengths,
    enclosed_volume,
    face_areas,
    face_normals,
    inspect_topology,
    outward_share,
    require_sheet,
    subdivide_quads,
    triangulate,
    unique_edges,
    vertex_areas,
    vertex_normals,
)


def tensors(mesh):
    return torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int64)


@pytest.fixture
def sphere():
    return tensors(trimesh.creation.icosphere(3, 1.0))


def tube(rings=4, around=6):
    """An open cylinder of quads: two boundary loops."""
    angle = 2 * math.pi * torch.arange(around) / around
    height = torch.arange(rings).float()
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    points = torch.cat([circle.repeat(rings, 1), height.repeat_interleave(around)[:, None]], 1)
    i = torch.arange(around)
    quads = torch.cat([torch.stack([r * around + i, r * around + (i + 1) % around], 1) for r in range(rings - 1)])
    return QuadMesh(points, torch.cat([quads, quads.flip(1) + around], 1))


def test_a_sphere_is_closed_manifold_oriented_and_whole(sphere):
    vertices, faces = sphere
    topology = require_sheet(vertices, faces)
    assert topology.closed
    assert topology.manifold
    assert topology.oriented
    assert topology.parts == 1
    assert boundary_loops(faces) == ()
    assert len(vertices) - len(topology.edges) + len(faces) == 2  # Euler


def test_an_open_tube_has_two_loops_that_follow_its_faces():
    mesh = tube()
    faces = triangulate(mesh)
    topology = require_sheet(mesh.vertices, faces)
    loops = boundary_loops(faces)
    assert [len(loop) for loop in loops] == [6, 6]
    assert sum(map(len, loops)) == len(topology.boundary_edges)
    walked = {(int(a), int(b)) for face in faces.tolist() for a, b in zip(face, face[1:] + face[:1], strict=True)}
    for loop in loops:
        assert all((int(a), int(b)) in walked for a, b in zip(loop, loop.roll(-1), strict=True))


def test_areas_normals_and_volume_of_the_sphere(sphere):
    vertices, faces = sphere
    assert torch.allclose(vertex_normals(vertices, faces), vertices, atol=0.02)
    assert ((face_normals(vertices, faces) * vertices[faces].mean(1)).sum(1) > 0.99).all()
    assert face_areas(vertices, faces).sum() == pytest.approx(4 * math.pi, rel=0.02)
    assert vertex_areas(vertices, faces).sum() == pytest.approx(float(face_areas(vertices, faces).sum()), rel=1e-5)
    assert enclosed_volume(vertices, faces) == pytest.approx(4 / 3 * math.pi, rel=0.03)
    assert enclosed_volume(vertices, faces.flip(1)) == pytest.approx(-float(enclosed_volume(vertices, faces)), rel=1e-5)


def test_measures_come_batched(sphere):
    vertices, faces = sphere
    batch = torch.stack([vertices, 2 * vertices])
    assert torch.allclose(face_areas(batch, faces)[1], 4 * face_areas(vertices, faces), rtol=1e-5)
    assert torch.allclose(vertex_normals(batch, faces)[1], vertex_normals(vertices, faces), atol=1e-5)
    edges = unique_edges(faces)
    assert torch.allclose(edge_lengths(batch, edges)[1], 2 * edge_lengths(vertices, edges), rtol=1e-5)


def test_quad_subdivision_keeps_shape_orientation_and_boundary():
    mesh = tube()
    fine = subdivide_quads(mesh)
    assert len(fine.quads) == 4 * len(mesh.quads)
    assert torch.equal(fine.vertices[: len(mesh.vertices)], mesh.vertices)
    coarse_area = face_areas(mesh.vertices, triangulate(mesh)).sum()
    assert face_areas(fine.vertices, triangulate(fine)).sum() == pytest.approx(float(coarse_area), rel=1e-5)
    require_sheet(fine.vertices, triangulate(fine))
    assert [len(loop) for loop in boundary_loops(triangulate(fine))] == [12, 12]
    centres = fine.vertices[triangulate(fine)].mean(1) * torch.tensor([1.0, 1.0, 0.0])
    assert ((face_normals(fine.vertices, triangulate(fine)) * centres).sum(1) > 0).all()


def test_a_garment_turned_inside_out_is_seen(sphere):
    body, faces = sphere
    shell = 1.1 * body
    assert outward_share(shell, faces, body, faces) > 0.99
    assert outward_share(shell, faces.flip(1), body, faces) < 0.01


def planted(kind):
    mesh = tube()
    vertices, faces = mesh.vertices, triangulate(mesh)
    if kind == "nan":
        vertices = vertices.clone()
        vertices[3, 1] = float("nan")
    elif kind == "three faces on an edge":
        vertices = torch.cat([vertices, torch.tensor([[0.0, 0.0, 9.0]])])
        topology = inspect_topology(faces, len(vertices))
        first, second = topology.edges[topology.edge_face_count == 2][0].tolist()
        faces = torch.cat([faces, torch.tensor([[first, second, len(vertices) - 1]])])
    elif kind == "pinched vertex":
        other = torch.where(faces == 0, 0, faces + len(vertices))
        vertices = torch.cat([vertices, vertices + 5.0])
        faces = torch.cat([faces, other])
        used, faces = torch.unique(faces, return_inverse=True)
        vertices = vertices[used]
    elif kind == "two parts":
        faces = torch.cat([faces, faces + len(vertices)])
        vertices = torch.cat([vertices, vertices + 5.0])
    elif kind == "one face flipped":
        faces = faces.clone()
        faces[4] = faces[4].flip(0)
    elif kind == "degenerate":
        faces = torch.cat([faces, torch.tensor([[0, 0, 1]])])
    elif kind == "unused":
        vertices = torch.cat([vertices, torch.zeros(2, 3)])
    elif kind == "index":
        faces = torch.cat([faces, torch.tensor([[0, 1, 99]])])
    elif kind == "empty":
        faces = faces[:0]
    return vertices, faces


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("nan", "1 of 24 vertices are NaN or infinite"),
        ("three faces on an edge", "1 edges have more than two faces"),
        ("pinched vertex", "1 vertices join sheets"),
        ("two parts", "expected one connected part, got 2"),
        ("one face flipped", "2 edges lie between faces of opposite orientation"),
        ("degenerate", "1 faces name a vertex twice"),
        ("unused", "2 vertices belong to no face"),
        ("index", "faces index vertex 99, but the mesh has 24 vertices"),
        ("empty", "no faces"),
    ],
)
def test_every_bad_mesh_gets_its_one_line(kind, says):
    vertices, faces = planted(kind)
    with pytest.raises(ValueError, match=says) as caught:
        require_sheet(vertices, faces, "shirt")
    assert "\n" not in str(caught.value)


def test_facts_of_a_bad_mesh_can_still_be_read():
    vertices, faces = planted("pinched vertex")
    topology = inspect_topology(faces, len(vertices))
    assert topology.pinched_vertices.tolist() == [0]
    assert not topology.manifold


def test_loops_that_touch_are_refused():
    faces = torch.tensor([[0, 1, 2], [0, 3, 4]])
    with pytest.raises(ValueError, match="two boundary loops touch"):
        boundary_loops(faces)
