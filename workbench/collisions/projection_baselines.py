"""Fig. 3 b, c: the two unposings that Eq. 9 is held against.  M_G (T,N,3), beta, theta -> X (T,N,3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import FieldValues, LinearFields, Rigging
from workbench.collisions.garment_model import BodyState, LocalMap
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint


@dataclass(frozen=True)
class SurfaceRigging:
    """Skinning weights and blendshape directions of body vertices, one for each garment vertex."""

    weights: Float[Tensor, "N J"]
    shape_directions: Float[Tensor, "K N 3"]
    pose_directions: Float[Tensor, "P N 3"]

    def at(self, state: BodyState) -> Rigging:
        """Contracted with the beta and theta of one frame."""
        shape = torch.einsum("k,kni->ni", state.betas, self.shape_directions)
        pose = torch.einsum("p,pni->ni", state.pose_coefficients, self.pose_directions)
        return Rigging(self.weights, shape + pose)


def nearest_rigging(body: Body, points: Float[Tensor, "N 3"], surface: Float[Tensor, "V 3"]) -> SurfaceRigging:
    """What the nearest vertex of `surface` (the body in some pose) has, for each point."""
    hit = ClosestPoint(surface.numpy(), body.faces.numpy()).query(points.numpy())
    corner = torch.from_numpy(hit.barycentric).argmax(dim=-1)
    nearest = body.faces[torch.from_numpy(hit.face).long(), corner]
    return SurfaceRigging(body.weights[nearest], body.shape_directions[:, nearest], body.pose_directions[:, nearest])


def unpose_with(rigging: Rigging, garment: Float[Tensor, "N 3"], state: BodyState) -> Float[Tensor, "N 3"]:
    """Inverse linear blend skinning with a given rigging: A^-1 (M_G - t) - B_s - B_p."""
    local = LocalMap.of(rigging, state)
    return local.pulled_back(garment - local.translation) - local.offset


def constant_weights(
    body: Body, template: Float[Tensor, "N 3"], garment: Float[Tensor, "T N 3"], state: BodyState
) -> Float[Tensor, "T N 3"]:
    """Fig. 3 b: each vertex keeps the weights of the body vertex nearest to it in the template, in every frame."""
    rigging = nearest_rigging(body, template, body.template)
    frames = [unpose_with(rigging.at(state[frame]), target, state[frame]) for frame, target in enumerate(garment)]
    return torch.stack(frames)


def nearest_weights(
    body: Body,
    garment: Float[Tensor, "T N 3"],
    state: BodyState,
    posed_bodies: Float[Tensor, "T V 3"],
) -> Float[Tensor, "T N 3"]:
    """Fig. 3 c: each vertex takes, frame by frame, the weights of the posed body vertex nearest to it."""
    return torch.stack(
        [
            unpose_with(nearest_rigging(body, target, posed).at(state[frame]), target, state[frame])
            for frame, (target, posed) in enumerate(zip(garment, posed_bodies, strict=True))
        ]
    )


class ConstantFields(LinearFields):
    """What earlier work gives each garment vertex, wherever it goes: the rigging of its body vertex in the template.

    With it `GarmentModel` poses garments of the constant-weight unposed space (Tab. 1, the 2019-style row).
    """

    def __init__(self, body: Body, rigging: SurfaceRigging):
        self.pose_map = body.pose_map
        self.rows = FieldValues(
            rigging.weights, rigging.shape_directions.transpose(0, 1), rigging.pose_directions.transpose(0, 1)
        )

    def at(self, points: Float[Tensor, "*B N 3"]) -> FieldValues:
        """Errors: ValueError for another number of vertices than the template's."""
        rows = self.rows
        if points.shape[-2] != len(rows.weights):
            raise ValueError(f"{points.shape[-2]} points, but the rigging of {len(rows.weights)} template vertices")
        batch = points.shape[:-2]
        return FieldValues(
            rows.weights.expand(*batch, *rows.weights.shape),
            rows.shape_directions.expand(*batch, *rows.shape_directions.shape),
            rows.pose_directions.expand(*batch, *rows.pose_directions.shape),
        )


def constant_fields(body: Body, garment: Garment) -> ConstantFields:
    """The constant rigging of a garment."""
    return ConstantFields(body, nearest_rigging(body, garment.vertices, body.template))
