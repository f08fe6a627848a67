"""Laws of Eq. 9-12: what was posed comes back, energies fall, bad vertices are mended, bad input is named."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.projection import (
    ProjectionConfig,
    ProjectionJob,
    Projector,
    collision_energy,
    fixed_point,
    levenberg_marquardt,
    neighbour_table,
    project_all,
    reconstruction_energy,
    strain_energy,
)
from workbench.collisions.projection_baselines import constant_weights, nearest_weights
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.strain import rest_triangles


class BallSDF(BodySDF):
    """The signed distance of a ball: known everywhere."""

    def __init__(self, centre: Tensor, radius: float):
        self.centre, self.radius = centre, radius

    def __call__(self, points: Tensor) -> Tensor:
        return (points - self.centre).norm(dim=-1) - self.radius


CENTRE = torch.tensor([0.0, 0.0, 1.1])


def sphere(radius: float, rings: int = 14, sectors: int = 20) -> tuple[Tensor, Tensor]:
    """An open barrel of triangles around the chest."""
    height = torch.linspace(-0.8, 0.8, rings)
    angle = torch.arange(sectors) * (2 * torch.pi / sectors)
    circle = torch.stack([angle.cos(), angle.sin()], dim=-1)
    profile = (1 - height.square()).sqrt()
    points = torch.cat([profile[:, None, None] * circle, height[:, None, None].expand(rings, sectors, 1)], dim=-1)
    faces = []
    for ring in range(rings - 1):
        for sector in range(sectors):
            a, b = ring * sectors + sector, ring * sectors + (sector + 1) % sectors
            faces += [[a, b, b + sectors], [a, b + sectors, a + sectors]]
    return CENTRE + radius * points.reshape(-1, 3), torch.tensor(faces)


@pytest.fixture(scope="module")
def model(body, analytic_fields) -> GarmentModel:
    return GarmentModel(body, analytic_fields(body, sharpness=8.0))


@pytest.fixture(scope="module")
def projector(model) -> Projector:
    vertices, faces = sphere(0.25)
    return Projector(model, BallSDF(CENTRE, 0.2), rest_triangles(vertices, faces), vertices)


@pytest.fixture(scope="module")
def sequence(model, projector):
    """A canonical garment that ripples, posed through a short motion."""
    generator = torch.Generator().manual_seed(0)
    pose = 0.25 * torch.randn(31, 3, generator=generator)
    rotations = torch.stack([axis_angle_to_matrix(step * pose) for step in torch.linspace(0, 1, 5)])
    betas = 0.7 * torch.randn(10, generator=generator)
    state = model.state(rotations, betas, torch.zeros(5, 3))
    ripple = 0.01 * torch.sin(40 * projector.template[:, 2:]) * torch.linspace(0, 1, 5)[:, None, None]
    canonical = CENTRE + (projector.template - CENTRE) * (1 + ripple)
    return canonical, model.posed(canonical, state), state


def test_what_was_posed_comes_back(projector, sequence):
    canonical, garment, state = sequence
    projection = projector.project(garment, state)
    assert projection.error.max() < 1e-4
    assert (projection.canonical - canonical).norm(dim=-1).max() < 1e-3
    assert not projection.mended.any()


def test_the_stated_error_is_the_error_of_eq_10(projector, model, sequence):
    _, garment, state = sequence
    projection = projector.project(garment, state)
    again = (garment - model.posed(projection.canonical, state)).norm(dim=-1)
    assert torch.allclose(again, projection.error, atol=1e-6)


def test_sequences_together_are_sequences_one_by_one(projector, sequence):
    _, garment, state = sequence
    jobs = [ProjectionJob(projector, garment[:3], state[:3]), ProjectionJob(projector, garment[2:], state[2:])]
    together = project_all(jobs, workers=2)
    for job, found in zip(jobs, together, strict=True):
        assert torch.equal(found.canonical, projector.project(job.garment, job.state).canonical)


def test_newton_steps_find_what_the_fixed_point_circles_around(model, projector, sequence):
    canonical, garment, state = sequence
    far = canonical[2] + 0.03 * torch.randn(canonical[2].shape, generator=torch.Generator().manual_seed(1))
    frame = torch.full((len(far),), 2)
    X, error = levenberg_marquardt(model, garment[2], state[frame], far, ProjectionConfig(newton_steps=30))
    assert error.max() < 1e-4
    assert (X - canonical[2]).norm(dim=-1).max() < 1e-3


def test_neighbours_are_those_that_share_an_edge(projector):
    table = neighbour_table(projector.rest.faces, len(projector.template))
    edges = {frozenset(e) for f in projector.rest.faces.tolist() for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    assert {frozenset((v, n)) for v, row in enumerate(table.tolist()) for n in row if n >= 0} == edges


def test_each_step_of_the_fixed_point_contracts(model, projector, sequence):
    _, garment, state = sequence
    errors = [
        fixed_point(
            model, garment[2], state[2], projector.template, ProjectionConfig(fixed_point_steps=steps, tolerance=0.0)
        )[1].mean()
        for steps in (1, 2, 3, 4)
    ]
    assert all(after < 0.5 * before for before, after in zip(errors, errors[1:], strict=False))


def test_rest_pose_and_mean_shape_return_the_garment_itself(model, projector):
    state = model.state(model.body.rest_rotations()[None], model.body.mean_shape(), torch.zeros(1, 3))
    target = (projector.template + 0.01)[None]
    assert torch.allclose(projector.project(target, state).canonical, target, atol=1e-5)


def test_a_vertex_inside_the_body_is_pushed_out_for_little_error(projector, sequence):
    canonical, _, state = sequence
    dented = canonical.clone()
    dented[:, 130] = CENTRE + 0.994 * 0.2 * torch.nn.functional.normalize(dented[:, 130] - CENTRE, dim=-1)
    garment = projector.model.posed(dented, state)
    assert (projector.sdf(projector.unskin(garment, state).canonical)[:, 130] < 0).all()
    projection = projector.project(garment, state)
    assert (projector.sdf(projection.canonical) >= 0).all()
    assert projection.mended[:, 130].all()
    assert projection.error.max() < 4e-3


def test_mending_never_raises_the_energy(projector, sequence):
    canonical, _, state = sequence
    dented = CENTRE + (canonical - CENTRE) * 0.799
    garment = projector.model.posed(dented, state)
    start = projector.unskin(garment, state)
    mended = projector.mend(garment, state, start)
    for frame in range(len(garment)):
        before = projector.energy(garment[frame], state[frame], start.canonical[frame]).total(projector.config)
        after = projector.energy(garment[frame], state[frame], mended.canonical[frame]).total(projector.config)
        assert after <= before * (1 + 1e-5)


def test_without_the_collision_term_the_vertex_stays_inside(projector, sequence):
    canonical, _, state = sequence
    dented = canonical.clone()
    dented[:, 130] = CENTRE + 0.994 * 0.2 * torch.nn.functional.normalize(dented[:, 130] - CENTRE, dim=-1)
    garment = projector.model.posed(dented, state)
    blind = replace(projector, config=ProjectionConfig(collision_weight=0.0, strain_weight=0.0))
    assert (projector.sdf(blind.project(garment, state).canonical)[:, 130] < 0).any()


def test_energies_are_zero_where_they_should_be(projector):
    X = projector.template
    assert reconstruction_energy(X, X) == 0
    assert strain_energy(X, projector.rest) < 1e-8
    assert collision_energy(torch.tensor([0.002, 0.5]), clearance=0.001) == 0
    assert collision_energy(torch.tensor([-0.002, 0.5]), clearance=0.001) == pytest.approx(0.003)


def garment_on_skin(body: Body) -> Tensor:
    return body.template[::60]


def test_both_baselines_undo_the_skinning_of_points_on_the_skin(body, analytic_fields):
    generator = torch.Generator().manual_seed(0)
    rotations = axis_angle_to_matrix(0.2 * torch.randn(3, 31, 3, generator=generator))
    betas = torch.randn(10, generator=generator)
    posed = body.vertices(rotations, betas)
    state = GarmentModel(body, analytic_fields(body)).state(rotations, betas)
    skin = garment_on_skin(body)
    garment = posed[:, ::60]
    for X in (constant_weights(body, skin, garment, state), nearest_weights(body, garment, state, posed)):
        assert (X - skin).norm(dim=-1).median() < 1e-4


def test_another_garment_is_refused(projector, sequence):
    _, garment, state = sequence
    with pytest.raises(ValueError, match="279 garment vertices, but the template has 280"):
        projector.project(garment[:, :-1], state)


def test_frame_counts_that_differ_are_refused(projector, sequence):
    _, garment, state = sequence
    with pytest.raises(ValueError, match="4 garment frames, but 5 body frames"):
        projector.project(garment[:4], state)


def test_a_diverged_frame_is_named(projector, sequence):
    _, garment, state = sequence
    broken = garment.clone()
    broken[2, 7, 1] = torch.nan
    with pytest.raises(ValueError, match=r"frame 2 holds NaN or infinity \(1 such frames\)"):
        projector.project(broken, state)
