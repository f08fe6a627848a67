"""SDF of Eq. 12: exact, learned, tabulated."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from workbench.body.model import Body
from workbench.collisions.body_sdf import ExactSDF, GridSDF, GridSDFConfig, LearnedSDF
from workbench.garments import Garment
from workbench.geometry.field_grid import GridConfig
from workbench.geometry.sampling import sample_shell, sample_surface


@pytest.fixture(scope="module")
def exact():
    return ExactSDF(Body.default())


@pytest.fixture(scope="module")
def grid():
    return GridSDF.default()


@pytest.fixture(scope="module")
def samples():
    body = Body.default()
    return sample_surface(body.template.numpy(), body.faces.numpy(), 3000, np.random.default_rng(1))


@pytest.fixture(scope="module")
def near():
    body = Body.default()
    points = sample_shell(body.template.numpy(), body.faces.numpy(), 2000, 0.005, 0.04, np.random.default_rng(2))
    return torch.from_numpy(points)


def test_the_exact_distance_has_a_gradient_of_length_one_towards_the_surface(exact, near):
    points = near.clone().requires_grad_(True)
    distance = exact(points)
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(len(points)), atol=1e-3, rtol=0)
    foot = points.detach() - distance.detach()[:, None] * gradient
    assert exact(foot).abs().max() < 1e-4


def test_the_sign_is_negative_inside(exact, body):
    centre = body.joint_template[body.joint_names.index("Spine")][None]
    assert exact(centre) < -0.03
    assert exact(torch.tensor([[2.0, 0.0, 1.0]])) > 1


def test_the_table_meets_its_bounds(exact, grid, near, samples):
    assert (grid(near) - exact(near)).abs().mean() < 2e-4
    surface = torch.from_numpy(samples.point)
    assert grid(surface).abs().max() < 3e-3
    for offset, allowed in ((1e-3, 0.01), (-1e-3, 0.01), (5e-3, 0.0), (-5e-3, 0.0)):
        points = surface + offset * torch.from_numpy(samples.normal)
        truth = exact(points)
        there = truth / offset > 0.9
        wrong = (grid(points) > 0) != (truth > 0)
        assert wrong[there].float().mean() <= allowed


def test_the_network_that_ships_is_no_worse_than_the_published_one_on_skin_and_tshirt(body, exact, samples):
    learned = LearnedSDF.default()
    surface = torch.from_numpy(samples.point)
    with torch.no_grad():
        found = learned(surface).abs()
        assert found.mean() < 1e-3
        assert found.quantile(0.95) < 3.5e-3
        points = Garment.load("tshirt").vertices
        assert (learned(points) - exact(points)).abs().mean() < 0.25e-3
        for offset, allowed in ((1e-3, 0.084), (-5e-3, 0.118)):
            points = surface + offset * torch.from_numpy(samples.normal)
            truth = exact(points)
            there = truth / offset > 0.9
            assert ((learned(points) > 0) != (truth > 0))[there].float().mean() <= allowed


def test_beyond_the_box_the_distance_keeps_growing(grid):
    points = torch.tensor([[5.0, 0.0, 1.0], [6.0, 0.0, 1.0]])
    near, far = grid(points)
    assert far - near == pytest.approx(1.0, abs=1e-3)


def test_the_tables_gradient_is_its_slope(grid, near):
    assert torch.autograd.gradcheck(grid, (near[:20].double().requires_grad_(True),), eps=1e-8, atol=1e-4)


def test_finer_tables_err_less(body, exact, near):
    def error(depth):
        config = GridSDFConfig(tolerance=1e-3, grid=GridConfig(0.2, depth))
        return float((GridSDF.tabulate(body, config)(near) - exact(near)).abs().mean())

    assert error(3) < 0.5 * error(1)


def test_tables_and_networks_of_another_body_are_refused(body, grid, tmp_path):
    other = replace(body, template=body.template * 1.01)
    with pytest.raises(ValueError, match="the grid was made for another body"):
        GridSDF(grid.grid, other)
    LearnedSDF(body).save(tmp_path)
    with pytest.raises(ValueError, match="trained for another body"):
        LearnedSDF.load(tmp_path, other)


def test_points_that_are_not_finite_are_refused(exact, grid):
    for sdf in (exact, grid):
        with pytest.raises(ValueError, match="points must be finite"):
            sdf(torch.tensor([[0.0, float("inf"), 1.0]]))
