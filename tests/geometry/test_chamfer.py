"""Chamfer distance: two ways agree, gradients are right, symmetric, blind to order and rigid motion."""

import numpy as np
import pytest
import torch

from workbench.geometry.chamfer import NearestPoint, chamfer_distance, match, plane_distance


@pytest.fixture
def clouds(rng):
    return torch.from_numpy(rng.normal(size=(700, 3))).float(), torch.from_numpy(rng.normal(size=(900, 3))).float()


def test_nearest_points_are_those_of_brute_force(clouds):
    x, y = clouds
    squared = (x[:, None] - y).square().sum(-1)
    found = match(x, y)
    assert torch.equal(found.of_x, squared.argmin(1))
    assert torch.equal(found.of_y, squared.argmin(0))
    expected = squared.min(1).values.mean() + squared.min(0).values.mean()
    torch.testing.assert_close(chamfer_distance(x, y, found), expected)


def test_some_rows_are_looked_at_from_one_side_only(clouds):
    """Every x finds its nearest in all of y; only the rows that are asked for look back."""
    x, y = clouds
    rows = torch.tensor([5, 3, 800])
    whole, some = match(x, y), match(x, y, rows=rows)
    assert torch.equal(some.of_x, whole.of_x)
    assert torch.equal(some.of_y, whole.of_y[rows])
    expected = (x - y[whole.of_x]).square().sum(-1).mean() + (y[rows] - x[whole.of_y[rows]]).square().sum(-1).mean()
    torch.testing.assert_close(chamfer_distance(x, y, some), expected)


def test_distance_is_symmetric_and_zero_only_for_the_same_cloud(clouds):
    x, y = clouds
    torch.testing.assert_close(chamfer_distance(x, y, match(x, y)), chamfer_distance(y, x, match(y, x)))
    shuffled = x[torch.randperm(len(x), generator=torch.Generator().manual_seed(0))]
    assert chamfer_distance(x, shuffled, match(x, shuffled)) == 0
    assert chamfer_distance(x, y, match(x, y)) > 0


def test_a_small_shift_costs_twice_its_square(clouds):
    """Both ways see it: 2 |d|^2 while everyone's neighbour stays who it was."""
    x, _ = clouds
    x = x[:50]
    moved = x + torch.tensor([3e-4, 0, 4e-4])
    torch.testing.assert_close(
        chamfer_distance(moved, x, match(moved, x)), torch.tensor(2 * 25e-8), rtol=1e-3, atol=1e-9
    )


def test_gradients_are_those_of_differences(clouds):
    x, y = clouds[0][:20].double().requires_grad_(), clouds[1][:30].double().requires_grad_()
    found = match(x, y)
    assert torch.autograd.gradcheck(lambda a, b: chamfer_distance(a, b, found), (x, y))
    normals = torch.nn.functional.normalize(clouds[0][:30].double(), dim=-1)
    assert torch.autograd.gradcheck(lambda a: plane_distance(a, y.detach(), normals, found), (x,))


def test_the_plane_forgives_sliding(clouds):
    """Points moved within the plane of a flat cloud stay at distance zero; moved across it, at their height."""
    flat = clouds[1] * torch.tensor([1.0, 1.0, 0.0])
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(len(flat), 3)
    x = clouds[0] * torch.tensor([1.0, 1.0, 0.0])
    assert plane_distance(x, flat, normals, match(x, flat)) == 0
    lifted = x + torch.tensor([0.0, 0.0, 0.02])
    torch.testing.assert_close(plane_distance(lifted, flat, normals, match(lifted, flat)), torch.tensor(4e-4))
    assert chamfer_distance(x, flat, match(x, flat)) > 0


def test_unusable_clouds_are_named():
    with pytest.raises(ValueError, match="the cloud has no points"):
        NearestPoint(np.zeros((0, 3), np.float32))
    with pytest.raises(ValueError, match="cloud must be finite, but row 1"):
        NearestPoint(np.array([[0, 0, 0], [0, np.nan, 0]], np.float32))
