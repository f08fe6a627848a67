"""The adaptive grid: exact where it must be, finer is better, continuous, differentiable, kept by its file."""

import numpy as np
import pytest
import torch

from workbench.geometry.field_grid import FieldGrid, GridConfig, Quantisation, load_compact, tabulate

LOW, HIGH = np.full(3, -1.0), np.full(3, 1.0)


def sphere_and_wave(points):
    p = points.astype(np.float64)
    return np.stack([np.linalg.norm(p, axis=1) - 0.5, np.sin(3 * p[:, 0]) * p[:, 1]], axis=1)


def build(field=sphere_and_wave, tolerance=2e-3, depth=4, step=None, simplex=None, channels=2):
    return tabulate(
        field,
        lambda surplus, points: np.abs(surplus).max(1) / tolerance,
        LOW,
        HIGH,
        Quantisation(np.full(channels, step or tolerance / 20), simplex),
        GridConfig(root_size=0.25, depth=depth),
    )


@pytest.fixture(scope="module")
def grid():
    return build()


@pytest.fixture
def points(rng):
    return torch.from_numpy(rng.uniform(-1, 1, (4000, 3)).astype(np.float32))


def test_error_stays_near_the_tolerance_and_falls_with_it(points):
    errors = []
    for tolerance in (1e-2, 2e-3):
        value = build(tolerance=tolerance, depth=5).at(points).numpy()
        errors.append(np.abs(value - sphere_and_wave(points.numpy())))
        assert errors[-1].max() < 2.5 * tolerance
    assert errors[1].mean() < errors[0].mean() / 3


def test_a_linear_field_is_met_exactly_by_the_root_cells(points):
    def linear(p):
        return p @ np.array([[1.0, 2.0], [0.5, -1.0], [2.0, 0.0]]) + 0.25

    flat = build(linear, step=2.0**-10)
    assert len(flat.compact.splits[0]) == 512
    assert not flat.compact.splits[0].any()
    np.testing.assert_allclose(flat.at(points).numpy(), linear(points.numpy()), atol=2e-3)


def test_cells_are_small_only_where_the_field_bends(grid, points):
    leaf = grid.locate(points)
    distance = points.norm(dim=1)
    assert leaf.size[distance < 0.1].mean() < 0.5 * leaf.size[distance > 0.8].mean()


def test_it_is_continuous_across_cells_of_different_size(grid, rng):
    faces = torch.from_numpy(rng.uniform(-1, 1, (3000, 3)))
    faces[:, 0] = torch.round(faces[:, 0] * 64) / 64  # every plane that can separate two cells
    step = torch.tensor([1e-9, 0, 0], dtype=torch.float64)
    inner = faces[:, 0].abs() < 0.999
    assert (grid.at(faces + step) - grid.at(faces - step))[inner].abs().max() < 1e-6


def test_the_gradient_is_the_derivative(grid, rng):
    points = torch.from_numpy(rng.uniform(-0.95, 0.95, (20, 3))).requires_grad_(True)
    assert torch.autograd.gradcheck(grid.at, (points,), eps=1e-7, atol=1e-5)


def test_two_ways_to_find_the_leaf_agree(grid, points):
    one, two = grid._locate_by_warp(points), grid._locate_by_torch(points)
    assert torch.equal(one.nodes, two.nodes)
    torch.testing.assert_close(one.weights, two.weights)
    assert torch.equal(one.size, two.size)


def test_outside_of_the_box_the_border_holds(grid):
    far = torch.tensor([[5.0, 0.1, 0.2]], requires_grad=True)
    value = grid.at(far)
    torch.testing.assert_close(value, grid.at(torch.tensor([[1.0, 0.1, 0.2]])))
    value.sum().backward()
    assert far.grad is not None
    assert far.grad[0, 0] == 0


def test_channels_of_a_simplex_sum_to_one_everywhere(points):
    def weights(p):
        soft = np.exp(-4 * np.stack([np.linalg.norm(p - c, axis=1) for c in np.eye(3)], axis=1))
        return soft / soft.sum(1, keepdims=True)

    value = build(weights, tolerance=0.01, step=1 / 1024, simplex=(0, 3), channels=3).at(points)
    assert (value.sum(1) - 1).abs().max() < 1e-6
    assert value.min() > -1e-6
    assert np.abs(value.numpy() - weights(points.numpy())).max() < 0.03


def test_round_trip_through_the_file(grid, points, tmp_path):
    grid.save(tmp_path / "grid.npz")
    again = FieldGrid.load(tmp_path / "grid.npz")
    assert torch.equal(again.at(points), grid.at(points))
    assert (tmp_path / "grid.npz").stat().st_size < grid.values.numel()


def test_shapes_of_a_batch_are_kept(grid):
    assert grid.at(torch.zeros(2, 5, 3)).shape == (2, 5, 2)
    assert grid.at(torch.zeros(0, 3)).shape == (0, 2)


def test_damaged_and_missing_files_are_named(grid, tmp_path):
    with pytest.raises(ValueError, match="there is no grid .*assets_gen checkpoints"):
        FieldGrid.load(tmp_path / "none.npz")
    grid.save(tmp_path / "grid.npz")
    data = (tmp_path / "grid.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"cut.npz is unusable"):
        FieldGrid.load(tmp_path / "cut.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="no grid of this format"):
        load_compact(tmp_path / "other.npz")


def test_points_that_are_not_finite_are_refused(grid):
    with pytest.raises(ValueError, match="points must be finite, but 1 are not"):
        grid.at(torch.tensor([[0.0, float("nan"), 0.0], [0.0, 0.0, 0.0]]))
