"""Laws of the collision count: exact on shapes whose inside is known."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.collisions.penetration import each_frame, penetration, surface_penetration
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.winding import winding_number


@pytest.fixture(scope="module")
def ball() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).long()


def test_points_of_a_ball_are_counted_by_radius(ball):
    vertices, faces = ball
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    garment = torch.stack([0.97 * directions, 1.01 * directions])
    found = penetration(vertices[None], faces, garment)
    assert found.inside[0].all()
    assert not found.inside[1].any()
    assert found.share == 0.5
    assert found.per_frame.tolist() == [200, 0]
    assert not found.overlap.any()


def test_the_body_moves_with_its_frames(ball):
    vertices, faces = ball
    bodies = torch.stack([vertices, vertices + torch.tensor([5.0, 0, 0])])
    garment = torch.zeros(2, 1, 3)
    assert penetration(bodies, faces, garment).inside[:, 0].tolist() == [True, False]


def test_overlap_is_inside_and_told_apart(ball):
    vertices, faces = ball
    shifted = vertices + torch.tensor([1.0, 0, 0])
    both, both_faces = torch.cat([vertices, shifted]), torch.cat([faces, faces + len(vertices)])
    garment = torch.tensor([[[-0.5, 0, 0], [0.5, 0, 0], [3.0, 0, 0]]])
    found = penetration(both[None], both_faces, garment)
    assert found.inside[0].tolist() == [True, True, False]
    assert found.overlap[0].tolist() == [False, True, False]


def test_differing_frames_and_broken_vertices_are_refused(ball):
    vertices, faces = ball
    with pytest.raises(ValueError, match="2 body frames, but 3 garment frames"):
        penetration(vertices.expand(2, -1, -1), faces, torch.zeros(3, 4, 3))
    with pytest.raises(ValueError, match="the garment holds NaN"):
        penetration(vertices[None], faces, torch.full((1, 4, 3), torch.nan))
    with pytest.raises(ValueError, match="the body holds NaN"):
        surface_penetration(vertices[None] * torch.inf, faces, torch.zeros(1, 4, 3), faces)


def test_equals_the_unfiltered_winding_number_on_a_body_that_overlaps_itself(body):
    """The count by ways out of the body against the sum over all its faces: posed frames, arms in the torso."""
    rng = np.random.default_rng(1)
    vectors = torch.from_numpy(rng.normal(0, 0.1, (3, len(body.parents), 3))).float()
    vectors[:, body.joint_names.index("LeftArm"), 1] = torch.tensor([0.5, 0.8, 1.1])
    bodies = body.vertices(axis_angle_to_matrix(vectors), body.mean_shape())
    choice = torch.from_numpy(rng.choice(body.weights.shape[0], 300))
    garment = bodies[:, choice] + torch.from_numpy(rng.normal(0, 0.01, (3, 300, 3))).float()
    found = penetration(bodies, body.faces, garment)
    for frame in range(3):
        exact = winding_number(garment[frame].numpy(), bodies[frame].numpy(), body.faces.numpy())
        np.testing.assert_array_equal(found.inside[frame].numpy(), exact > 0.5)
        np.testing.assert_array_equal(found.overlap[frame].numpy(), exact > 1.5)
    assert found.overlap.any()


def test_a_sheet_through_a_ball_crosses_between_its_vertices(ball):
    """Two triangles of a square that cuts the ball, all corners outside: no vertex collides, edges and faces do."""
    vertices, faces = ball
    square = torch.tensor([[-2.0, -2, 0.3], [2, -2, 0.3], [2, 2, 0.3], [-2, 2, 0.3]])
    sheet = torch.tensor([[0, 1, 2], [0, 2, 3]])
    found = surface_penetration(vertices[None], faces, torch.stack([square, square + torch.tensor([0, 0, 2.0])]), sheet)
    assert not found.inside.any()
    diagonal = (found.edges == torch.tensor([0, 2])).all(1)
    assert diagonal.sum() == 1
    assert torch.equal(found.crossing_edges[0], diagonal)
    assert torch.equal(found.hidden_edges, found.crossing_edges)
    assert found.hidden_faces.tolist() == [[True, True], [False, False]]
    assert found.poking.sum(dim=1)[1] == 0
    standing_out = found.poking[0].nonzero()[:, 0]
    assert len(standing_out) > 10
    assert (vertices[standing_out, 2] > 0.3).all()  # the square's normal shows upwards, away from most of the ball


def test_vertices_inside_are_not_hidden(ball):
    vertices, faces = ball
    sheet = torch.tensor([[0.0, 0, 0], [0, 0, 3], [0, 3, 3]])
    found = surface_penetration(vertices[None], faces, sheet[None], torch.tensor([[0, 1, 2]]))
    assert found.inside[0].tolist() == [True, False, False]
    assert found.crossing_edges.sum() == 2
    assert not found.hidden_edges.any()
    assert found.crossing_faces.all()
    assert not found.hidden_faces.any()
    assert found.edge_share == pytest.approx(2 / 3)
    assert found.face_share == 1.0


def test_crossings_do_not_depend_on_where_everything_is(ball):
    """Rigid motion of both changes no count."""
    vertices, faces = ball
    generator = torch.Generator().manual_seed(3)
    sheet = torch.randn(30, 3, generator=generator)
    triangles = torch.randint(30, (40, 3), generator=generator)
    triangles = triangles[(triangles.sort(1).values.diff(dim=1) > 0).all(1)]
    R = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 0.3]))
    here = surface_penetration(vertices[None], faces, sheet[None], triangles)
    there = surface_penetration((vertices @ R.T + 1.5)[None], faces, (sheet @ R.T + 1.5)[None], triangles)
    assert here.crossing_edges.any()
    for name in ("inside", "crossing_edges", "crossing_faces", "hidden_edges"):
        assert torch.equal(getattr(here, name), getattr(there, name)), name


@pytest.mark.parametrize("threads", [1, 2])
def test_every_frame_is_done_once_whatever_the_threads(threads):
    torch.set_num_threads(threads)
    seen: list[int] = []
    try:
        each_frame(9, lambda: seen.append)
    finally:
        torch.set_num_threads(1)
    assert sorted(seen) == list(range(9))
    each_frame(0, lambda: seen.append)
    assert len(seen) == 9
