"""Laws of the distance in posed space."""

import pytest
import torch

from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import penetration
from workbench.collisions.posed_distance import PosedDistance
from workbench.garments import Garment
from workbench.geometry.mesh import vertex_normals
from workbench.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(scope="module")
def distance(body) -> PosedDistance:
    return PosedDistance(GarmentModel(body, GridFields.default()))


def rest(body, count: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    return body.rest_rotations()[None].repeat(count, 1, 1, 1), torch.zeros(count, body.shape_count)


def test_the_template_at_rest_is_outside_and_what_is_pushed_in_is_inside(body, distance):
    X = Garment.load("tshirt").vertices[None]
    assert float(distance.of(X, *rest(body)).min()) > 0.0
    surface = body.template[None, ::40]
    normals = vertex_normals(body.template, body.faces)[None, ::40]
    for depth in (0.003, -0.003):
        found = distance.of(surface - depth * normals, *rest(body))
        assert float((found + depth).abs().median()) < 2e-4


def test_it_agrees_with_the_exact_inside_test(body, distance):
    """At rest, and in a pose that overlaps itself."""
    rotations, betas = rest(body)
    crossed = rotations.clone()
    crossed[0, body.joint_names.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 0.7, 0.0]))
    for pose in (rotations, crossed):
        bodies = body.vertices(pose, betas)
        points = bodies[:, ::7] + 0.01 * torch.randn(bodies[:, ::7].shape, generator=torch.Generator().manual_seed(0))
        found = distance.between(points, bodies)
        truth = penetration(bodies, body.faces, points).inside & (found.abs() < distance.reach)
        wrong = float(((found < 0) != truth).float().mean())
        assert wrong <= 0.001, f"{100 * wrong:.2f} % of the signs are wrong"


def test_a_step_up_the_gradient_frees_vertices(body, distance):
    X = (Garment.load("tshirt").vertices[None] * torch.tensor([0.9, 0.9, 1.0])).requires_grad_()
    before = distance.of(X, *rest(body))
    (gradient,) = torch.autograd.grad(before.sum(), X)
    after = distance.of((X + 0.004 * gradient).detach(), *rest(body))
    inside = before < 0
    assert int(inside.sum()) > 100
    assert float((after < 0).float().sum()) < 0.8 * float(inside.sum())


def test_where_the_body_overlaps_itself_the_way_out_ends_on_skin_that_is_seen(body, distance):
    """A thigh in the belly: its skin is no way out for what is in both."""
    rotations, betas = rest(body)
    rotations[0, body.joint_names.index("LeftUpLeg")] = axis_angle_to_matrix(torch.tensor([-2.3, 0.0, 0.0]))
    bodies = body.vertices(rotations, betas)
    normals = vertex_normals(bodies, body.faces)
    hidden = penetration(bodies, body.faces, bodies + 0.002 * normals).inside[0]
    points = (bodies - 0.005 * normals)[:, hidden].requires_grad_()
    assert points.shape[1] > 100
    found = distance.between(points, bodies)
    assert float((found < 0).float().mean()) > 0.9
    (away,) = torch.autograd.grad(found.sum(), points)
    points, found = points.detach(), found.detach()
    out = points - (found - 0.001).clamp(max=0.0)[..., None] * away
    assert float(penetration(bodies, body.faces, out).inside.float().mean()) < 0.1
    assert float((out - points).norm(dim=-1).max()) < distance.overlap_reach + 0.002


def test_far_vertices_have_no_gradient(body, distance):
    X = torch.full((1, 5, 3), 3.0, requires_grad=True)
    found = distance.of(X, *rest(body))
    (gradient,) = torch.autograd.grad(found.sum(), X)
    assert (found == distance.reach).all()
    assert gradient.abs().max() == 0
