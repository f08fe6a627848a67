"""Fig. 3 b, c: the two unposings that Eq. 9 is held against.  M_G (T,N,3), beta, theta -> X (T,N,3)."""

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skinning import blended_affine
from workbench.collisions.diffused_body import FieldValues
from workbench.collisions.garment_model import BodyState, LocalMap, offsets
from workbench.geometry.closest_point import ClosestPoint


def surface_values(body: Body, points: Float[Tensor, "N 3"], surface: Float[Tensor, "V 3"]) -> FieldValues:
    """Skinning weights and blendshapes of the nearest vertex of `surface` (a pose of the body) for each point."""
    hit = ClosestPoint(surface.numpy(), body.faces.numpy()).query(points.numpy())
    corner = torch.from_numpy(hit.barycentric).argmax(dim=-1)
    nearest = body.faces[torch.from_numpy(hit.face).long(), corner]
    return FieldValues(
        body.weights[nearest],
        body.shape_directions[:, nearest].movedim(0, 1),
        body.pose_directions[:, nearest].movedim(0, 1),
    )


def unpose_with(values: FieldValues, garment: Float[Tensor, "N 3"], state: BodyState) -> Float[Tensor, "N 3"]:
    """Inverse linear blend skinning with given values: A^-1 (M_G - t) - B~s - B~p."""
    rotation, translation = blended_affine(values.weights, state.transforms)
    local = LocalMap(rotation, translation, offsets(values, state))
    return local.pulled_back(garment - translation) - local.offset


def constant_weights(
    body: Body, template: Float[Tensor, "N 3"], garment: Float[Tensor, "T N 3"], state: BodyState
) -> Float[Tensor, "T N 3"]:
    """Fig. 3 b: each vertex keeps the weights of the body vertex nearest to it in the template, in every frame."""
    values = surface_values(body, template, body.template)
    return torch.stack([unpose_with(values, target, state[frame]) for frame, target in enumerate(garment)])


def nearest_weights(
    body: Body,
    garment: Float[Tensor, "T N 3"],
    state: BodyState,
    posed_bodies: Float[Tensor, "T V 3"],
) -> Float[Tensor, "T N 3"]:
    """Fig. 3 c: each vertex takes, frame by frame, the weights of the posed body vertex nearest to it."""
    return torch.stack(
        [
            unpose_with(surface_values(body, target, posed), target, state[frame])
            for frame, (target, posed) in enumerate(zip(garment, posed_bodies, strict=True))
        ]
    )
