"""Laws of the collision count: exact on shapes whose inside is known."""

import pytest
import torch
import trimesh

from workbench.collisions.penetration import penetration


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
    with pytest.raises(ValueError, match="holds NaN"):
        penetration(vertices[None], faces, torch.full((1, 4, 3), torch.nan))
