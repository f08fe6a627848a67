"""Laws of Eq. 7-8, with analytic fields in double precision and with the fields that ship."""

import pytest
import torch
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields, MonteCarloFields
from workbench.collisions.garment_model import GarmentModel
from workbench.geometry.rotations import axis_angle_to_matrix


def random_pose(body: Body, spread: float = 0.3) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    vectors = spread * torch.randn(len(body.parents), 3, generator=generator, dtype=torch.float64)
    return axis_angle_to_matrix(vectors).to(body.template.dtype)


@pytest.fixture(scope="module")
def analytic(body, analytic_fields) -> GarmentModel:
    double = body.to(dtype=torch.float64)
    return GarmentModel(double, analytic_fields(double))


@pytest.fixture
def points(analytic) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(40, 3, generator=generator, dtype=torch.float64) + torch.tensor([-0.5, -0.5, 0.7]).double()


def test_the_rest_pose_of_the_mean_shape_is_canonical_space(analytic, points):
    state = analytic.state(analytic.body.rest_rotations(), analytic.body.mean_shape())
    assert torch.allclose(analytic.posed(points, state), points, atol=1e-9)


def test_eq_8_is_the_sum_of_its_terms(analytic, points):
    body, betas, pose = analytic.body, torch.ones(10).double(), random_pose(analytic.body)
    state = analytic.state(pose, betas)
    expected = (
        points
        + analytic.fields.shape_offsets(points, betas)
        + analytic.fields.pose_offsets(points, body.pose_feature(pose))
    )
    assert torch.allclose(analytic.unposed(points, state), expected)
    assert torch.allclose(analytic.local_map(points, state).unposed(points), expected)


def test_a_turned_root_turns_the_garment(analytic, points):
    pose = random_pose(analytic.body)
    turn = axis_angle_to_matrix(torch.tensor([0.1, 0.2, 1.5]).double())
    turned = pose.clone()
    turned[0] = turn @ pose[0]
    mean, root = analytic.body.mean_shape(), analytic.body.joint_template[0]
    before = analytic.posed(points, analytic.state(pose, mean))
    after = analytic.posed(points, analytic.state(turned, mean))
    assert torch.allclose(after - root, (before - root) @ turn.mT, atol=1e-9)


def test_any_vertex_set_is_posed_point_by_point(analytic, points):
    state = analytic.state(random_pose(analytic.body), analytic.body.mean_shape())
    some = torch.tensor([5, 1, 30])
    assert torch.allclose(analytic.posed(points[some], state), analytic.posed(points, state)[some])


def test_frames_together_are_frames_one_by_one(analytic, points):
    poses = torch.stack([random_pose(analytic.body, spread) for spread in (0.1, 0.4)])
    betas = torch.randn(2, 10, generator=torch.Generator().manual_seed(0)).double()
    shift = torch.tensor([[0.0, 0, 1], [2, 0, 0]]).double()
    state = analytic.state(poses, betas, shift)
    together = analytic.posed(points.expand(2, -1, -1), state)
    for frame in range(2):
        alone = analytic.state(poses[frame], betas[frame], shift[frame])
        assert torch.allclose(together[frame], analytic.posed(points, alone))
        assert torch.allclose(together[frame], analytic.posed(points, state[frame]))


def test_pulling_back_undoes_the_blended_rotation(analytic, points):
    local = analytic.local_map(points, analytic.state(random_pose(analytic.body), torch.ones(10).double()))
    offset = torch.randn(points.shape, generator=torch.Generator().manual_seed(0)).double()
    pushed = (local.rotation @ offset[..., None])[..., 0]
    assert torch.allclose(local.pulled_back(pushed), offset)


def test_it_is_differentiable_in_garment_shape_and_pose(analytic, points):
    def posed(X: Tensor, betas: Tensor, vectors: Tensor) -> Tensor:
        return analytic.posed(X, analytic.state(axis_angle_to_matrix(vectors), betas))

    generator = torch.Generator().manual_seed(1)
    betas = torch.randn(10, generator=generator).double().requires_grad_()
    vectors = (0.3 * torch.randn(31, 3, generator=generator)).double().requires_grad_()
    assert torch.autograd.gradcheck(posed, (points[:2].clone().requires_grad_(), betas, vectors))


def test_on_the_skin_the_garment_model_is_the_body_model(body):
    model = GarmentModel(body, MonteCarloFields(body, samples=8))
    pose, betas = random_pose(body), torch.randn(10, generator=torch.Generator().manual_seed(0))
    some = torch.arange(0, len(body.template), 97)
    posed = model.posed(body.template[some], model.state(pose, betas))
    assert torch.allclose(posed, body.vertices(pose, betas)[some], atol=2e-3)


def test_the_table_poses_a_garment_as_the_definition_does(body):
    pose, betas = random_pose(body), torch.randn(10, generator=torch.Generator().manual_seed(0))
    around = body.template[::40] + 0.02 * torch.nn.functional.normalize(body.template[::40] - body.template.mean(0))
    grid = GarmentModel(body, GridFields.default())
    definition = GarmentModel(body, MonteCarloFields(body, samples=2048))
    gap = grid.posed(around, grid.state(pose, betas)) - definition.posed(around, definition.state(pose, betas))
    assert gap.norm(dim=-1).mean() < 1e-3


def test_broken_vertices_are_refused(analytic, points):
    broken = points.clone()
    broken[3] = torch.nan
    state = analytic.state(analytic.body.rest_rotations(), analytic.body.mean_shape())
    with pytest.raises(ValueError, match="1 of the garment's canonical vertices are NaN"):
        analytic.posed(broken, state)


def test_a_pose_of_another_skeleton_is_refused(analytic):
    with pytest.raises(ValueError, match="24 joints, but body 'default' has 31"):
        analytic.state(torch.eye(3).double().repeat(24, 1, 1), analytic.body.mean_shape())
