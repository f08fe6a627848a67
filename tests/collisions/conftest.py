"""Stand-ins: smooth fields with known formulas and exact gradients for Eq. 4-6; a small training set."""

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.canonical_set import CanonicalSequence, CanonicalSet
from workbench.collisions.diffused_body import FieldValues, LinearFields
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix


class AnalyticFields(LinearFields):
    """Weights by a soft nearest joint, blendshape directions linear in the point."""

    def __init__(self, body: Body, sharpness: float = 20.0):
        self.pose_map = body.pose_map
        self._joints, self._sharpness = body.joint_template, sharpness
        generator = torch.Generator().manual_seed(9)
        shape = torch.randn(body.shape_count, 3, 3, generator=generator)
        pose = torch.randn(len(body.pose_directions), 3, 3, generator=generator)
        self._shape, self._pose = 0.02 * shape.to(body.template), 0.01 * pose.to(body.template)

    def at(self, points: Float[Tensor, "*B N 3"]) -> FieldValues:
        squared = (points[..., None, :] - self._joints).square().sum(dim=-1)
        return FieldValues(
            torch.softmax(-self._sharpness * squared, dim=-1),
            torch.einsum("kij,...nj->...nki", self._shape, points),
            torch.einsum("pij,...nj->...npi", self._pose, points),
        )


@pytest.fixture(scope="session")
def analytic_fields() -> type[AnalyticFields]:
    """The class: `analytic_fields(body)` makes the fields of a body."""
    return AnalyticFields


@pytest.fixture(scope="session")
def small_set(body) -> CanonicalSet:
    garment = Garment.load("tshirt")
    generator = torch.Generator().manual_seed(0)
    smooth = torch.sin(garment.vertices[None] * torch.rand(30, 1, 3, generator=generator) * 9)
    rows = torch.linalg.qr(smooth.flatten(1).T).Q.T * len(garment.vertices) ** 0.5

    def sequence(seed: int, split: str) -> CanonicalSequence:
        chance = torch.Generator().manual_seed(seed)
        turns = 0.03 * torch.randn(24, len(body.parents), 3, generator=chance).cumsum(0)
        return CanonicalSequence(
            coefficients=0.002 * torch.randn(24, 30, generator=chance).cumsum(0),
            rotations=axis_angle_to_matrix(turns),
            translation=0.01 * torch.randn(24, 3, generator=chance).cumsum(0),
            betas=torch.randn(10, generator=chance),
            valid=torch.rand(24, generator=chance) > 0.1,
            motion_name=f"walk_{seed}",
            split=split,
        )

    sequences = (sequence(1, "train"), sequence(2, "train"), sequence(3, "validation"))
    return CanonicalSet("tshirt", garment.vertices, rows.unflatten(1, (-1, 3)), sequences, 30.0, 0.0)
