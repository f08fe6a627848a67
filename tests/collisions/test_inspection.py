"""Laws of the inspection: depth and region of known cases, sums that must agree, incidents, the report."""

import json

import pytest
import torch
import trimesh

from workbench.collisions.body_regions import BodyRegions
from workbench.collisions.incidents import incidents
from workbench.collisions.inspection import Inspection, inspect_collisions
from workbench.collisions.inspection_report import inspection_report, worst_vertices
from workbench.collisions.penetration import penetration, surface_penetration
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.winding import winding_number


@pytest.fixture(scope="module")
def ball() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).long()


def halves(vertices: torch.Tensor) -> BodyRegions:
    return BodyRegions(("lower", "upper"), (vertices[:, 2] > 0).long(), "a test")


@pytest.fixture(scope="module")
def dented(ball) -> Inspection:
    """A ball in a wider ball; in frame 1 a cap of it is 0.2 inside at the top, in frames 2 and 3 one at the bottom."""
    vertices, faces = ball
    garment = (1.1 * vertices).repeat(5, 1, 1)
    garment[1, vertices[:, 2] > 0.9] *= 0.8 / 1.1
    garment[2:4, vertices[:, 2] < -0.95] *= 0.9 / 1.1
    return inspect_collisions(vertices[None], faces, garment, faces, halves(vertices))


def test_depth_is_the_distance_below_the_surface(ball, dented):
    vertices, _ = ball
    assert dented.depth[0].max() == 0
    top = vertices[:, 2] > 0.9
    torch.testing.assert_close(dented.depth[1, top], torch.full((int(top.sum()),), 0.2), atol=4e-3, rtol=0)
    torch.testing.assert_close(dented.signed_distance[0], torch.full((len(vertices),), 0.1), atol=4e-3, rtol=0)


def test_cells_hold_the_region_and_sum_to_the_frame(ball, dented):
    vertices, _ = ball
    assert dented.heat_map.tolist() == [
        [0, 0],
        [0, int((vertices[:, 2] > 0.9).sum())],
        [int((vertices[:, 2] < -0.95).sum()), 0],
        [int((vertices[:, 2] < -0.95).sum()), 0],
        [0, 0],
    ]
    assert torch.equal(dented.heat_map.sum(dim=1), dented.inside.sum(dim=1))
    torch.testing.assert_close(dented.depth_map.amax(dim=1), dented.depth.amax(dim=1))
    assert torch.equal(
        dented.region_of_vertex[vertices[:, 2].abs() > 0.1], halves(vertices).of_vertex[vertices[:, 2].abs() > 0.1]
    )


def test_says_the_same_as_the_single_counts_and_the_exact_sum(body):
    """On posed frames of a body that overlaps itself, threads and all: nothing is lost by taking them together."""
    generator = torch.Generator().manual_seed(2)
    vectors = 0.1 * torch.randn(3, len(body.parents), 3, generator=generator)
    vectors[:, body.joint_names.index("LeftArm"), 1] = torch.tensor([0.5, 0.8, 1.1])
    bodies = body.vertices(axis_angle_to_matrix(vectors), body.mean_shape())
    near = (body.template[:, 2] > 1.0) & (body.template[:, 2] < 1.1)
    renumber = near.cumsum(0) - 1
    faces = renumber[body.faces[near[body.faces].all(1)]]
    garment = bodies[:, near] + 0.004 * torch.randn(3, int(near.sum()), 3, generator=generator)
    torch.set_num_threads(2)
    try:
        found = inspect_collisions(bodies, body.faces, garment, faces)
    finally:
        torch.set_num_threads(1)
    alone = penetration(bodies, body.faces, garment)
    assert torch.equal(found.inside, alone.inside)
    assert torch.equal(found.overlap, alone.overlap)
    surfaces = surface_penetration(bodies, body.faces, garment, faces)
    for name in ("crossing_edges", "crossing_faces", "poking", "hidden_edges", "hidden_faces"):
        assert torch.equal(getattr(found.surfaces, name), getattr(surfaces, name)), name
    for frame in range(3):
        exact = winding_number(garment[frame].numpy(), bodies[frame].numpy(), body.faces.numpy())
        assert torch.equal(found.inside[frame], torch.from_numpy(exact > 0.5))
    assert 0.2 < found.inside.float().mean() < 0.8


def test_incidents_are_patches_over_time(ball, dented):
    vertices, _ = ball
    first, second = incidents(dented)
    assert (first.first_frame, first.last_frame, first.region) == (1, 1, "upper")
    assert (second.first_frame, second.last_frame, second.region) == (2, 3, "lower")
    assert first.vertices == int((vertices[:, 2] > 0.9).sum())
    assert first.depth == pytest.approx(0.2, abs=4e-3)
    assert dented.depth[first.worst_frame, first.worst_vertex] == pytest.approx(first.depth)


def test_nothing_is_found_where_nothing_collides(ball):
    vertices, faces = ball
    found = inspect_collisions(vertices[None], faces, 1.1 * vertices[None], faces, halves(vertices))
    assert incidents(found) == ()
    assert worst_vertices(found) == []
    report = inspection_report(found, 30.0)
    assert report["totals"]["inside"] == 0
    assert report["totals"]["depth_mm"] == {"mean": 0.0, "median": 0.0, "max": 0.0}


def test_the_report_is_json_in_millimetres_and_its_sums_agree(dented):
    report = json.loads(json.dumps(inspection_report(dented, 25.0)))
    assert report["fps"] == 25.0
    assert report["totals"]["inside"] == sum(report["per_frame"]["inside"]) == int(dented.inside.sum())
    assert report["totals"]["inside"] == sum(map(sum, report["inside_by_frame_and_region"]))
    assert report["totals"]["depth_mm"]["max"] == pytest.approx(200, abs=4)
    assert report["totals"]["frames_with_collisions"] == 3
    worst = report["worst_vertices"]
    assert worst[0]["depth_mm"] == report["totals"]["depth_mm"]["max"] == max(report["per_frame"]["deepest_mm"])
    assert (worst[0]["frame"], worst[0]["region"], worst[0]["frames_inside"]) == (1, "upper", 1)
    assert [w["depth_mm"] for w in worst] == sorted((w["depth_mm"] for w in worst), reverse=True)
    assert report["totals"]["crossing_edges"] == sum(report["per_frame"]["crossing_edges"]) > 0
    assert [i["region"] for i in report["incidents"]] == ["upper", "lower"]
