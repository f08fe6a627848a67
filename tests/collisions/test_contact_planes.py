"""Laws of contact planes: true where they were looked at, and to first order around."""

import pytest
import torch

from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.contact_planes import MILLI, ContactPlanes
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.posed_distance import PosedDistance
from workbench.collisions.worn_poses import WornPoses
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix

HALF = 0.02  # millimetres: what float16 leaves of 40


@pytest.fixture(scope="module")
def distance(body) -> PosedDistance:
    return PosedDistance(GarmentModel(body, GridFields.default()))


@pytest.fixture(scope="module")
def worn(body) -> WornPoses:
    rotations = body.rest_rotations()[None].repeat(2, 1, 1, 1)
    rotations[1, body.joint_names.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 0.4, 0.2]))
    return WornPoses(rotations, torch.zeros(2, body.shape_count), torch.zeros(2, 25))


def template(latents: torch.Tensor) -> torch.Tensor:
    return Garment.load("tshirt").vertices.expand(len(latents), -1, -1)


def seen(worn: WornPoses, offset: torch.Tensor, distance: PosedDistance) -> ContactPlanes:
    """Contacts of the template moved by `offset`, millimetres."""
    return ContactPlanes.of(worn, template, lambda *_: offset / MILLI, distance, GridSDF.default())


@pytest.mark.parametrize("size", [0.0, 6.0])
def test_where_they_were_looked_at_they_are_the_distances(worn, distance, size):
    offset = size * torch.randn(2, 4630, 3, generator=torch.Generator().manual_seed(1))
    posed, canonical = seen(worn, offset, distance).distances(offset)
    X = template(worn.latents) + offset / MILLI
    torch.testing.assert_close(
        posed, MILLI * distance.of(X, worn.rotations, worn.betas), atol=HALF + 0.002 * size, rtol=0
    )
    torch.testing.assert_close(canonical, MILLI * GridSDF.default()(X), atol=0.2 + 0.002 * size, rtol=0)


def test_around_it_their_error_falls_with_the_square_of_the_step(worn, distance):
    """A step twice as long strays four times as far, near the skin; of the many vertices, the usual one."""
    planes = seen(worn, torch.zeros(2, 4630, 3), distance)
    step = torch.nn.functional.normalize(torch.randn(2, 4630, 3, generator=torch.Generator().manual_seed(2)), dim=-1)
    near = planes.posed[..., 0] < 15.0

    def strayed(length: float) -> float:
        X = template(worn.latents) + length * step / MILLI
        truth = MILLI * distance.of(X, worn.rotations, worn.betas)
        return float((planes.distances(length * step)[0] - truth)[near].square().mean().sqrt())

    short, long = strayed(3.0), strayed(6.0)
    assert long < 1.0
    assert 1.7 < long / short < 6.0


def test_the_loss_can_be_lowered_along_them(worn, distance):
    planes = seen(worn, torch.zeros(2, 4630, 3), distance)
    offset = torch.zeros(2, 4630, 3, requires_grad=True)
    posed, canonical = planes.distances(offset)
    (posed.sum() + canonical.sum()).backward()
    assert offset.grad is not None
    torch.testing.assert_close(
        offset.grad, (planes.posed + planes.canonical.float())[..., 1:].float(), atol=2e-3, rtol=0
    )


def test_a_part_is_the_planes_of_its_poses(worn, distance):
    planes, index = seen(worn, torch.zeros(2, 4630, 3), distance), torch.tensor([1])
    part = planes[index]
    assert len(part) == 1
    torch.testing.assert_close(part.posed, planes.posed[1:])
    torch.testing.assert_close(part.worn.rotations, worn.rotations[1:])
