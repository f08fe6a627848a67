"""Laws of the collision term in posed space."""

import pytest
import torch

from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import penetration
from workbench.collisions.posed_collision import PosedCollision
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(scope="module")
def term(body) -> PosedCollision:
    return PosedCollision(GarmentModel(body, GridFields.default()), clearance=2e-3)


def rest(body, count: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    return body.rest_rotations()[None].repeat(count, 1, 1, 1), torch.zeros(count, body.shape_count)


def test_the_template_at_rest_costs_nothing(body, term):
    X = Garment.load("tshirt").vertices[None]
    assert float(term(X, *rest(body))) < 1e-4


def test_a_garment_pushed_into_the_body_costs_its_depth(body, term):
    surface = body.template[None, ::40]
    normals = torch.nn.functional.normalize(surface - surface.mean(1, keepdim=True), dim=-1)
    inner = surface - 0.003 * normals
    assert float(term(inner, *rest(body))) > float(term(surface, *rest(body))) > 0


def test_distance_agrees_with_the_exact_inside_test(body, term):
    """Everywhere at rest; in a pose that overlaps itself almost everywhere (see SURELY_OUTSIDE)."""
    rotations, betas = rest(body)
    crossed = rotations.clone()
    crossed[0, body.joint_names.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 0.7, 0.0]))
    for pose, allowed in ((rotations, 0.001), (crossed, 0.01)):
        bodies = body.vertices(pose, betas)
        points = bodies[:, ::7] + 0.01 * torch.randn(bodies[:, ::7].shape, generator=torch.Generator().manual_seed(0))
        found = term.distance(points, bodies)
        truth = penetration(bodies, body.faces, points).inside & (found.abs() < term.reach)
        wrong = float(((found < 0) != truth).float().mean())
        assert wrong <= allowed, f"{100 * wrong:.2f} % of the signs are wrong"


def test_a_step_down_the_gradient_frees_vertices(body, term):
    X = (Garment.load("tshirt").vertices[None] * torch.tensor([0.9, 0.9, 1.0])).requires_grad_()
    rotations, betas = rest(body)
    before = term(X, rotations, betas)
    (gradient,) = torch.autograd.grad(before, X)
    moved = X.detach() - 0.004 * torch.nn.functional.normalize(gradient, dim=-1)
    assert float(term(moved, rotations, betas)) < 0.8 * float(before.detach())


def test_far_vertices_have_no_gradient(body, term):
    X = torch.full((1, 5, 3), 3.0, requires_grad=True)
    loss = term(X, *rest(body))
    (gradient,) = torch.autograd.grad(loss, X)
    assert float(loss.detach()) == 0
    assert gradient.abs().max() == 0
