"""Regions: places with names where the weights are known, parts or patches where they are not."""

import pytest
import torch
import trimesh

from workbench.collisions import body_regions
from workbench.collisions.body_regions import PLACES, regions_of, surface_patches
from workbench.geometry.mesh import unique_edges


@pytest.fixture(scope="module")
def ball() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).long()


def test_every_joint_of_the_default_body_has_a_place(body):
    assert {joint for joints in PLACES.values() for joint in joints} == set(body.joint_names)


def test_places_of_the_default_body_are_where_their_names_say(body):
    regions = regions_of(body.template, body.faces)
    assert regions.names == tuple(PLACES)
    middle = {name: body.template[regions.of_vertex == k].mean(0) for k, name in enumerate(regions.names)}
    heights = [float(middle[name][2]) for name in ("left foot", "left shin", "left thigh", "pelvis", "belly", "chest")]
    assert heights == sorted(heights)
    assert middle["head"][2] > middle["neck"][2] > middle["chest"][2]
    for place in ("hand", "forearm", "upper arm", "shoulder", "thigh", "foot"):
        assert middle[f"left {place}"][0] > 0 > middle[f"right {place}"][0]  # the body's left is +x


def test_a_posed_body_keeps_its_places(body):
    again = regions_of(body.template + torch.randn_like(body.template), body.faces)
    assert torch.equal(again.of_vertex, regions_of(body.template, body.faces).of_vertex)


def test_parts_of_a_foreign_body(ball):
    vertices, faces = ball
    both, both_faces = torch.cat([vertices, vertices + 3]), torch.cat([faces, faces + len(vertices)])
    regions = regions_of(both, both_faces)
    assert regions.names == ("part 1", "part 2")
    assert regions.source == "connected parts"
    assert regions.of_vertex.tolist() == [0] * len(vertices) + [1] * len(vertices)


def test_patches_of_a_foreign_body_are_connected_and_about_equal(ball):
    vertices, faces = ball
    regions = regions_of(vertices, faces)
    assert len(regions.names) == body_regions.PATCHES
    assert regions.names[0].startswith("patch 1 (")
    sizes = torch.bincount(regions.of_vertex)
    assert sizes.min() > 10
    assert sizes.max() < 6 * sizes.min()
    edges = unique_edges(faces).numpy()
    for k in range(len(regions.names)):
        own = (regions.of_vertex == k).numpy()
        part = trimesh.graph.connected_components(edges[own[edges].all(1)], nodes=own.nonzero()[0])
        assert len(part) == 1


def test_fewer_vertices_than_patches():
    vertices, faces = torch.eye(3), torch.tensor([[0, 1, 2]])
    assert len(set(surface_patches(vertices, unique_edges(faces)).of_vertex.tolist())) == 3


def test_a_huge_body_is_one_region(ball, monkeypatch):
    monkeypatch.setattr(body_regions, "MOST_VERTICES", 100)
    assert regions_of(*ball).names == ("whole body",)


def test_the_regions_of_a_given_model(body, ball):
    shuffled = body.faces.flip(0)  # another mesh, same vertices: only the model knows its places
    assert regions_of(body.template, shuffled, body).names == tuple(PLACES)
    with pytest.raises(ValueError, match="the body has 642 vertices, but the model 'default' has 13348"):
        regions_of(*ball, model=body)
