"""Tab. 2's figures by hand, and the two ways of dressing that are timed."""

import pytest
import torch

from workbench.geometry.mesh import vertex_normals
from workbench.points.clothed_points import ClothedPoints
from workbench.points.dressing import Dresser
from workbench.points.evaluation import CloudError, cloud_error, dress_every_pixel, errors_on, statistics
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.training import ScanSet
from workbench.points.uv_position_map import atlas_of, posed_bodies


def test_errors_by_hand():
    """A plane seen 10 mm too high: the squares of it both ways, and once to the plane."""
    grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1)) * 0.1
    up = torch.tensor([0.0, 0.0, 1.0]).expand(400, 3)
    error = cloud_error(grid + 0.01 * up, up, ScanFrame(grid, up), "dress")
    assert error.chamfer == pytest.approx(2e-4, rel=1e-3)
    assert error.plane == pytest.approx(1e-4, rel=1e-3)
    assert error.normal == 0
    aside = cloud_error(grid + torch.tensor([0.01, 0, 0]), up, ScanFrame(grid, up), "dress")
    assert aside.chamfer == pytest.approx(2e-4, rel=1e-3)
    assert aside.plane < 1e-12


def test_columns_of_the_table():
    errors = [CloudError(outfit, value, 0.0, 0.0) for outfit, value in (("a", 1.0), ("a", 3.0), ("b", 5.0), ("c", 9.0))]
    column = statistics(errors, lambda error: error.chamfer)
    assert column.mean == 4.5
    assert column.outfit_median == 5.0
    assert column.outfit_max == 9.0
    with pytest.raises(ValueError, match="no clouds"):
        statistics([], lambda error: error.chamfer)


def test_every_frame_is_judged_against_its_own_scan(body):
    """Clouds that are the scans have no error; clouds of the bare body have that of the gap."""
    rotations = body.rest_rotations().repeat(2, 1, 1, 1)
    vertices = posed_bodies(body, rotations, body.mean_shape()).vertices
    normals = vertex_normals(vertices, body.faces)
    frames = [ScanFrame(v + 0.005 * n, n) for v, n in zip(vertices, normals, strict=True)]
    sequence = ScanSequence.of(
        frames, outfit="thick", motion="m", rotations=rotations, betas=body.mean_shape(), fps=30.0
    )
    scans = ScanSet.of(body, [sequence], input_size=32)

    def cloud_of(points, normals):
        return ClothedPoints(points[None], normals[None], torch.zeros_like(points)[None])

    exact = errors_on(scans, lambda batch: cloud_of(batch.scans[0].points, batch.scans[0].normals))
    bare = errors_on(scans, lambda batch: cloud_of(batch.bodies.vertices[0], batch.scans[0].normals))
    assert len(exact) == len(bare) == 2
    assert all(error.chamfer == 0 and error.outfit == "thick" for error in exact)
    assert all(error.plane == pytest.approx(25e-6, rel=0.2) for error in bare)


def test_both_ways_give_the_same_points(body, small_model, trained_like):
    model = trained_like(small_model)
    bodies = posed_bodies(body, body.rest_rotations()[None], body.mean_shape())
    queries = atlas_of(body, 48).queries
    image = atlas_of(body, 32).map_of(bodies.neutral)
    with torch.no_grad():
        geometry = model.geometry(torch.tensor([0]))
    plain = dress_every_pixel(model, geometry, image, queries, bodies, 48)
    fast = Dresser(model, geometry, body, queries=queries, precision="float32")(bodies)
    torch.testing.assert_close(fast.points, plain.points, atol=1e-6, rtol=0)
