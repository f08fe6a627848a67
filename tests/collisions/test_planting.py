"""Planted dents are where they were asked for."""

import pytest
import torch
import trimesh

from workbench.collisions.penetration import penetration
from workbench.collisions.planting import Plant, dent, planted
from workbench.geometry.mesh import unique_edges


@pytest.fixture(scope="module")
def ball() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).long()


def test_exactly_the_patch_is_inside_and_as_deep_as_asked(ball):
    vertices, faces = ball
    garment = 1.1 * vertices
    made = dent(garment, unique_edges(faces), vertices, faces, centre=7, rings=2, depth=0.05)
    inside = penetration(vertices[None], faces, made.garment[None]).inside[0]
    assert torch.equal(inside.nonzero()[:, 0], made.patch)
    assert 7 in made.patch
    assert len(made.patch) in (16, 19)  # a corner of the ball has 5 neighbours, any other vertex 6
    assert 1 - made.garment[7].norm() == pytest.approx(0.05, abs=2e-3)
    untouched = torch.ones(len(garment), dtype=torch.bool)
    untouched[made.patch] = False
    assert torch.equal(made.garment[untouched], garment[untouched])


def test_what_cannot_be_planted_is_refused(ball):
    vertices, faces = ball
    edges = unique_edges(faces)
    with pytest.raises(ValueError, match="there is no vertex 9999: the garment has 2562"):
        dent(vertices, edges, vertices, faces, centre=9999)
    with pytest.raises(ValueError, match="depth is 0"):
        dent(vertices, edges, vertices, faces, centre=0, depth=0.0)


def test_plants_are_in_their_frames_and_nowhere_else(ball):
    vertices, faces = ball
    garment, bodies = (1.1 * vertices).repeat(4, 1, 1), vertices.repeat(4, 1, 1)
    plants = [Plant(7, 1, 2, depth=0.05, rings=2), Plant(900, 3, 3, depth=0.02, rings=1)]
    made = planted(garment, unique_edges(faces), bodies, faces, plants)
    found = penetration(bodies, faces, made)
    assert found.per_frame.tolist() == [0, *[len(dent_patch(ball, 7, 2))] * 2, len(dent_patch(ball, 900, 1))]
    assert found.inside[1, 7]
    assert found.inside[3, 900]
    with pytest.raises(ValueError, match="frames 3 to 4 are not all there: the garment has 4"):
        planted(garment, unique_edges(faces), bodies, faces, [Plant(7, 3, 4)])


def dent_patch(ball, vertex, rings):
    vertices, faces = ball
    return dent(1.1 * vertices, unique_edges(faces), vertices, faces, vertex, rings, 0.05).patch
