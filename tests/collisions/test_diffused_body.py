"""Eq. 4-6: the definition, the networks and the table obey the same laws and agree."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from workbench.body.model import Body
from workbench.collisions.diffused_body import (
    FieldLayout,
    GridFields,
    GridFieldsConfig,
    LearnedFields,
    MonteCarloFields,
    body_attributes,
)
from workbench.collisions.field_training import random_pose_features
from workbench.geometry.field_grid import GridConfig
from workbench.geometry.sampling import sample_box, sample_shell, sample_surface


@pytest.fixture(scope="module")
def exact():
    return MonteCarloFields(Body.default(), samples=256, seed=5)


@pytest.fixture(scope="module")
def grid():
    return GridFields.default()


@pytest.fixture(scope="module")
def learned():
    return LearnedFields.default()


@pytest.fixture(scope="module")
def near():
    """Where garments are: 5 to 60 mm off the body."""
    body, rng = Body.default(), np.random.default_rng(1)
    return torch.from_numpy(sample_shell(body.template.numpy(), body.faces.numpy(), 400, 0.005, 0.06, rng))


@pytest.fixture(scope="module")
def anywhere():
    rng = np.random.default_rng(2)
    vertices = Body.default().template.numpy()
    return torch.from_numpy(sample_box(vertices.min(0) - 0.5, vertices.max(0) + 0.5, 300, rng))


def test_weights_are_a_partition_of_unity(exact, grid, learned, near, anywhere):
    for fields in (exact, grid, learned):
        for points in (near, anywhere):
            weights = fields.weights(points)
            torch.testing.assert_close(weights.sum(-1), torch.ones(len(points)), atol=1e-4, rtol=0)
            assert weights.min() > -1e-6


def test_on_the_surface_the_fields_are_the_bodys(body, exact, grid):
    samples = sample_surface(body.template.numpy(), body.faces.numpy(), 300, np.random.default_rng(3))
    points = torch.from_numpy(samples.point)
    found = exact.closest.query(samples.point)
    truth = FieldLayout.of(body).split(
        torch.from_numpy(found.interpolate(body_attributes(body).numpy(), body.faces.numpy()).astype(np.float32))
    )
    values = exact.at(points)
    # a neighbourhood of 0.1 mm
    assert (values.weights - truth.weights).abs().sum(-1).max() < 0.02
    assert (values.shape_directions - truth.shape_directions).norm(dim=-1).max() < 1e-3
    assert (grid.at(points).weights - truth.weights).abs().sum(-1).mean() < 0.03


def test_monte_carlo_error_falls_like_one_over_the_root(body, near):
    points = near[:120]
    truth = MonteCarloFields(body, samples=4096, seed=9).weights(points)

    def error(samples):
        runs = [MonteCarloFields(body, samples=samples, seed=s, quasi=False).weights(points) for s in range(6)]
        return float(torch.stack([(run - truth).abs().sum(-1).mean() for run in runs]).mean())

    few, many = error(16), error(256)
    assert 2.7 < few / many < 6  # 4 in expectation
    quasi = float((MonteCarloFields(body, samples=256).weights(points) - truth).abs().sum(-1).mean())
    assert quasi < 0.5 * many


def test_the_definition_repeats_and_a_seed_changes_it(body, near):
    one, same, other = (MonteCarloFields(body, samples=16, seed=s).weights(near) for s in (0, 0, 1))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_the_gradient_is_that_of_the_expectation(body, near):
    points = near[:12].clone().requires_grad_(True)
    many = MonteCarloFields(body, samples=8192, seed=1)
    mix = torch.randn(len(body.parents), generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad((many.weights(points) @ mix).sum(), points)
    step = 1e-3
    difference = torch.stack(
        [
            ((many.weights(points.detach() + step * e) - many.weights(points.detach() - step * e)) @ mix) / (2 * step)
            for e in torch.eye(3)
        ],
        dim=1,
    )
    assert (gradient - difference).norm() < 0.1 * difference.norm()


def test_offsets_are_linear_in_shape_and_pose(body, exact, grid, near):
    points = near[:50]
    betas = torch.randn(2, body.shape_count, generator=torch.Generator().manual_seed(0))
    features = random_pose_features(body, 2, seed=0)
    for fields in (exact, grid):
        shaped = [fields.shape_offsets(points, beta) for beta in betas]
        torch.testing.assert_close(fields.shape_offsets(points, betas.sum(0)), sum(shaped), atol=1e-6, rtol=1e-4)
        posed = [fields.pose_offsets(points, feature) for feature in features]
        torch.testing.assert_close(fields.pose_offsets(points, features.sum(0)), sum(posed), atol=1e-6, rtol=1e-4)


def test_rigging_is_the_three_fields_in_one(body, grid, learned, near):
    beta = torch.linspace(-1, 1, body.shape_count)
    feature = random_pose_features(body, 1, seed=4)[0]
    for fields in (grid, learned):
        rigging = fields.rigging(near, beta, feature @ body.pose_map)
        torch.testing.assert_close(rigging.weights, fields.weights(near))
        offset = fields.shape_offsets(near, beta) + fields.pose_offsets(near, feature)
        torch.testing.assert_close(rigging.offset, offset, atol=1e-5, rtol=1e-3)


def test_the_three_agree(exact, grid, learned, near, anywhere):
    many = MonteCarloFields(Body.default(), samples=1024, seed=6)  # far away, 256 samples see too little of the body
    for points, truth, of_grid, of_net in (
        (near, exact.at(near), 0.015, 0.05),
        (anywhere, many.at(anywhere), 0.07, 0.12),
    ):
        values = grid.at(points)
        assert (values.weights - truth.weights).abs().sum(-1).mean() < of_grid
        assert (learned.weights(points) - truth.weights).abs().sum(-1).mean() < of_net
        assert (values.shape_directions - truth.shape_directions).square().sum((-1, -2)).sqrt().mean() < 1e-3
        assert (values.pose_directions - truth.pose_directions).square().sum((-1, -2)).sqrt().mean() < 1e-3


def test_the_grids_gradient_is_its_slope(grid, near):
    points = near[:6].double().requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p: grid.at(p).weights, (points,), eps=1e-7, atol=1e-5)


def test_networks_are_differentiable_in_point_and_shape(body, learned, near):
    points = near[:5].clone().requires_grad_(True)
    betas = torch.zeros(body.shape_count, requires_grad=True)
    (learned.weights(points).square().sum() + learned.shape_offsets(points, betas).sum()).backward()
    assert points.grad is not None and points.grad.abs().sum() > 0
    assert betas.grad is not None and betas.grad.abs().sum() > 0


def test_secants_of_the_networks_have_the_shapes_of_the_others(body, learned, grid, near):
    values, table = learned.at(near[:4]), grid.at(near[:4])
    assert values.shape_directions.shape == table.shape_directions.shape
    assert values.pose_directions.shape == table.pose_directions.shape


def test_a_batch_of_garments_is_looked_up_at_once(grid, near):
    points = near[:200].reshape(4, 50, 3)
    torch.testing.assert_close(grid.at(points).weights.reshape(200, -1), grid.weights(near[:200]))


def test_finer_tables_err_less(body):
    points = torch.from_numpy(
        sample_shell(body.template.numpy(), body.faces.numpy(), 200, 0.01, 0.05, np.random.default_rng(4))
    )
    truth = MonteCarloFields(body, samples=32).weights(points)

    def error(depth):
        config = GridFieldsConfig(samples=32, weights=0.1, shape=0.02, pose=0.02, grid=GridConfig(0.4, depth))
        return float((GridFields.tabulate(body, config).weights(points) - truth).abs().sum(-1).mean())

    coarse, fine = error(1), error(3)
    assert fine < 0.6 * coarse


def test_fields_of_another_body_are_refused(body, grid, learned, tmp_path):
    other = replace(body, template=body.template * 1.01)
    with pytest.raises(ValueError, match="the grid was made for another body"):
        GridFields(grid.grid, other)
    learned.save(tmp_path)
    with pytest.raises(ValueError, match="trained for another body"):
        LearnedFields.load(tmp_path, other)
    fewer = replace(body, shape_directions=body.shape_directions[:4], joint_directions=body.joint_directions[:4])
    with pytest.raises(ValueError, match="the grid has 133 channels, but body 'default' needs 115"):
        GridFields(grid.grid, fewer)


def test_points_that_are_not_finite_are_refused(exact, grid):
    bad = torch.tensor([[0.0, float("nan"), 1.0]])
    for fields in (exact, grid):
        with pytest.raises(ValueError, match="points must be finite"):
            fields.at(bad)


def test_the_network_of_shape_is_linear_in_beta_and_its_directions_are_what_beta_mixes(body, rng):
    fields = LearnedFields(body, width=16, depth=2)
    points = torch.from_numpy(rng.normal(size=(20, 3))).float()
    a, b = (torch.from_numpy(rng.normal(size=10)).float() for _ in range(2))
    both = fields.shape_offsets(points, a + 2 * b)
    torch.testing.assert_close(both, fields.shape_offsets(points, a) + 2 * fields.shape_offsets(points, b))
    assert not fields.shape_offsets(points, torch.zeros(10)).any()
    directions = fields.shape_directions(points)
    torch.testing.assert_close(fields.at(points).shape_directions, directions)
    torch.testing.assert_close(directions[:, 3], fields.shape_offsets(points, torch.eye(10)[3]))
