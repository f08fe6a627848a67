"""Eq. 3-6: each term against its formula, and their sum."""

import pytest
import torch

from workbench.geometry.chamfer import match
from workbench.points.losses import (
    LOOSE,
    LossTerms,
    LossWeights,
    displacement_loss,
    distance_loss,
    geometry_loss,
    normal_loss,
)


def test_a_cloud_that_is_the_scan_costs_nothing(rng):
    y = torch.from_numpy(rng.normal(size=(200, 3))).float()
    n = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(200, 3))).float(), dim=-1)
    order = torch.from_numpy(rng.permutation(200))
    found = match(y[order], y)
    assert distance_loss(y[order], y, found) == 0
    assert normal_loss(n[order], n, found) == 0
    assert normal_loss(-n[order], n, found) > 1


def test_normals_by_hand():
    x, y = torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([[0.1, 0, 0], [0.9, 0, 0], [5, 0, 0]])
    n_x, n_y = torch.tensor([[0.0, 0, 1], [0, 1, 0]]), torch.tensor([[0.0, 1, 0], [0, 1, 0], [1, 0, 0]])
    torch.testing.assert_close(normal_loss(n_x, n_y, match(x, y)), torch.tensor((2.0 + 0.0) / 2))


def test_regularisers_by_hand():
    r = torch.tensor([[[0.3, 0, 0.4], [0, 0, 0]]])
    torch.testing.assert_close(displacement_loss(r), torch.tensor(0.125))
    torch.testing.assert_close(geometry_loss(torch.full((2, 3, 4, 4), 0.1)), torch.tensor(0.01))


def test_the_sum_is_the_weighted_one():
    one, two, three, four = (torch.tensor(float(k)) for k in (2, 3, 5, 7))
    total = LossTerms(one, two, three, four).total(
        LossWeights(distance=10.0, normal=1.0, displacement=0.1, geometry=0.01)
    )
    torch.testing.assert_close(total, torch.tensor(20 + 3 + 0.5 + 0.07))


def test_gradients_of_normals(rng):
    x = torch.from_numpy(rng.normal(size=(10, 3)))
    n_y = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(15, 3))), dim=-1)
    found = match(x.float(), torch.from_numpy(rng.normal(size=(15, 3))).float())
    n_x = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(10, 3))), dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(lambda n: normal_loss(n, n_y, found), (n_x,))


def test_how_far_short_of_the_cloth_a_point_settles():
    """One point, one scan point 10 cm off the body: 9 % short with the published weight, 1 % with ours."""

    def settled(weights):
        r = torch.zeros(1, 3, requires_grad=True)
        y = torch.tensor([[0.1, 0.0, 0.0]])
        for _ in range(60):
            matches = match(r, y)
            terms = LossTerms(distance_loss(r, y, matches), torch.zeros(()), displacement_loss(r), torch.zeros(()))
            (gradient,) = torch.autograd.grad(terms.total(weights), r)
            r = (r - 1e-5 * gradient).detach().requires_grad_()
        return float(r.detach()[0, 0])

    assert settled(LossWeights()) == pytest.approx(0.1 / 1.1, rel=1e-3)
    assert settled(LOOSE) == pytest.approx(0.1 / 1.01, rel=1e-3)
