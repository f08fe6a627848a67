"""Planted dents are where they were asked for."""

import pytest
import torch
import trimesh

from workbench.collisions.penetration import penetration
from workbench.collisions.planting import dent
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
