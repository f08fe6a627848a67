"""Smooth fields with known formulas and exact gradients, in any precision: a stand-in for Eq. 4-6 in tests."""

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import FieldValues, LinearFields


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
