"""The floor under every canonical model (facts.md 9): re-posing a STATIC template already collides.  motions -> shares.

A canonical garment that touches nothing can end inside the posed body, because linear blending folds space where limbs
close.  The floor is measured for a motion as it came, with its arms spread by a fixed angle (the usual preprocessing),
and cleared of self-contact; no learning on canonical garments alone can go below it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body, Skinning
from workbench.body.skinning import dual_quaternion
from workbench.collisions.diffused_body import FieldValues
from workbench.collisions.garment_model import GarmentModel, LocalMap
from workbench.collisions.penetration import Penetration, penetration
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion

REGIONS = ("torso", "arms", "legs", "head")


@dataclass(frozen=True)
class Floor:
    """Shares of the static template's vertices inside the posed body, 0..1."""

    share: float
    overlap_share: float
    region_share: dict[str, float]  # among the region's own vertices
    frames: int


def static_template_floor(
    model: GarmentModel,
    template: Float[Tensor, "N 3"],
    motions: Iterable[tuple[Motion, Float[Tensor, "K"]]],
    *,
    skinning: Skinning = "linear",
) -> Floor:
    """Pose the template by Eq. 7 through motions, each on a body shape, and count what is inside.

    With "dual_quaternion", W is that blend for body and garment, and B_p, fitted to linear blending, is left out.
    """
    values = model.fields.at(template)
    region = regions_of(model.body, values)
    found = [_reposed(model, template, values, motion, betas, skinning) for motion, betas in motions]
    inside = torch.cat([p.inside for p in found])
    overlap = torch.cat([p.overlap for p in found])
    shares = {
        name: float(inside[:, region == index].float().mean())
        for index, name in enumerate(REGIONS)
        if bool((region == index).any())
    }
    return Floor(float(inside.float().mean()), float(overlap.float().mean()), shares, len(inside))


@torch.no_grad()
def _reposed(
    model: GarmentModel,
    template: Float[Tensor, "N 3"],
    values: FieldValues,
    motion: Motion,
    betas: Float[Tensor, "K"],
    skinning: Skinning,
) -> Penetration:
    garment, bodies = [], []
    for frame in range(len(motion)):
        theta, shift = motion.rotations[frame], motion.translation[frame]
        state = model.state(theta, betas, shift)
        bodies.append(model.body.vertices(theta, betas, shift, skinning=skinning))
        if skinning == "linear":
            garment.append(LocalMap.of(values.rigging(betas, state.pose_coefficients), state).posed(template))
        else:
            rigging = values.rigging(betas, torch.zeros_like(state.pose_coefficients))
            garment.append(dual_quaternion(template + rigging.offset, rigging.weights, state.transforms))
    return penetration(torch.stack(bodies), model.body.faces, torch.stack(garment))


def regions_of(body: Body, values: FieldValues) -> Int[Tensor, "N"]:
    """The body region whose joints hold the most weight at each point: an index into REGIONS."""
    joint_region = torch.tensor([_region(name) for name in body.joint_names])
    sums = [values.weights[:, joint_region == index].sum(dim=1) for index in range(len(REGIONS))]
    return torch.stack(sums, dim=1).argmax(dim=1)


def _region(joint: str) -> int:
    lower = joint.lower()
    if any(part in lower for part in ("arm", "hand", "thumb", "finger", "elbow", "wrist")):
        return REGIONS.index("arms")
    if any(part in lower for part in ("leg", "foot", "toe", "knee", "ankle")):
        return REGIONS.index("legs")
    if any(part in lower for part in ("neck", "head")):
        return REGIONS.index("head")
    return REGIONS.index("torso")


def with_arms_spread(motion: Motion, angle: float) -> Motion:
    """Both arms raised sideways by a fixed angle (radians) at the shoulder, in every frame."""
    rotations = motion.rotations.clone()
    for joint, sign in (("LeftArm", -1.0), ("RightArm", 1.0)):
        index = motion.skeleton.index(joint)
        raise_arm = axis_angle_to_matrix(torch.tensor([0.0, sign * angle, 0.0]))
        rotations[:, index] = raise_arm @ rotations[:, index]
    return replace(motion, rotations=rotations)
