"""Eq. 7-8: the garment model M_G.  canonical X (N,3), beta (K), theta (J,3,3) -> posed garment (N,3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skinning import RigidTransforms, blended_affine
from workbench.collisions.diffused_body import DiffusedFields, Rigging


@dataclass(frozen=True)
class BodyState:
    """Frames of the body, as the garment model needs them: beta, the coefficients of B_p, joint transforms."""

    betas: Float[Tensor, "*B K"]
    pose_coefficients: Float[Tensor, "*B P"]
    transforms: RigidTransforms

    def __getitem__(self, index: int | slice | Tensor) -> "BodyState":
        """Frames picked from the leading axis."""
        return BodyState(
            self.betas[index],
            self.pose_coefficients[index],
            RigidTransforms(self.transforms.rotation[index], self.transforms.translation[index]),
        )


@dataclass(frozen=True)
class LocalMap:
    """M_G around given points, fields held fixed: posed = A (X + offset) + t, point by point."""

    rotation: Float[Tensor, "*B N 3 3"]  # A: the blended rotation
    translation: Float[Tensor, "*B N 3"]  # t
    offset: Float[Tensor, "*B N 3"]  # B~s(X, beta) + B~p(X, theta)

    @staticmethod
    def of(rigging: Rigging, state: BodyState) -> "LocalMap":
        """The map of points whose rigging is known."""
        rotation, translation = blended_affine(rigging.weights, state.transforms)
        return LocalMap(rotation, translation, rigging.offset)

    def unposed(self, X: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 3"]:
        """T_G = X + B~s + B~p      (Eq. 8)"""
        return X + self.offset

    def posed(self, X: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 3"]:
        """M_G = A T_G + t      (Eq. 7)"""
        return (self.rotation @ self.unposed(X)[..., None])[..., 0] + self.translation

    def pulled_back(self, offset: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 3"]:
        """A^-1 offset, by Cramer's rule; a blended rotation is singular only where a twist reaches 180 degrees."""
        first, second, third = self.rotation.unbind(dim=-1)
        cofactors = torch.stack(
            [torch.linalg.cross(second, third), torch.linalg.cross(third, first), torch.linalg.cross(first, second)], -2
        )
        determinant = (first * cofactors[..., 0, :]).sum(dim=-1, keepdim=True)
        return (cofactors @ offset[..., None])[..., 0] / determinant


@dataclass(frozen=True)
class GarmentModel:
    """Poses canonical garments with the diffused body.  Needs no training for a new garment, topology or vertex set."""

    body: Body
    fields: DiffusedFields

    def state(
        self,
        rotations: Float[Tensor, "*R J 3 3"],
        betas: Float[Tensor, "*S K"],
        translation: Float[Tensor, "*T 3"] | None = None,
    ) -> BodyState:
        """What theta and beta mean for any garment: computed once a frame."""
        transforms = self.body.pose(rotations, betas, translation).transforms
        batch = transforms.rotation.shape[:-3]
        coefficients = self.body.pose_coefficients(rotations)
        return BodyState(
            betas.expand(*batch, betas.shape[-1]), coefficients.expand(*batch, coefficients.shape[-1]), transforms
        )

    def local_map(self, X: Float[Tensor, "*B N 3"], state: BodyState) -> LocalMap:
        """W~, B~s and B~p at X, contracted with beta and theta."""
        return LocalMap.of(self.fields.rigging(X, state.betas, state.pose_coefficients), state)

    def unposed(self, X: Float[Tensor, "*B N 3"], state: BodyState) -> Float[Tensor, "*B N 3"]:
        """T_G(X, beta, theta) = X + B~s(X, beta) + B~p(X, theta)      (Eq. 8)"""
        return X + self.fields.rigging(X, state.betas, state.pose_coefficients).offset

    def posed(self, X: Float[Tensor, "*B N 3"], state: BodyState) -> Float[Tensor, "*B N 3"]:
        """M_G(X, beta, theta) = W(T_G, J(beta), theta, W~(X))      (Eq. 7)

        Differentiable in X, and in beta and theta through `state`.
        """
        _check_points(X)
        return self.local_map(X, state).posed(X)


def _check_points(X: Tensor) -> None:
    if not bool(torch.isfinite(X).all()):
        bad = int((~torch.isfinite(X).all(dim=-1)).sum())
        raise ValueError(
            f"{bad} of the garment's canonical vertices are NaN or infinite; mend the mesh before posing it"
        )
