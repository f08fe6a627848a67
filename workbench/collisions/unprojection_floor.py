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

from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import Penetration, penetration
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion

REGIONS = ("torso", "arms", "legs", "head")
FRAMES_AT_ONCE = 16


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
    dual_quaternions: bool = False,
) -> Floor:
    """Pose the template by Eq. 7 through motions, each on a body shape, and count what is inside."""
    region = regions_of(model, template)
    found = [_reposed(model, template, motion, betas, dual_quaternions) for motion, betas in motions]
    inside = torch.cat([p.inside for p in found])
    overlap = torch.cat([p.overlap for p in found])
    shares = {
        name: float(inside[:, region == index].float().mean())
        for index, name in enumerate(REGIONS)
        if bool((region == index).any())
    }
    return Floor(float(inside.float().mean()), float(overlap.float().mean()), shares, len(inside))


def _reposed(
    model: GarmentModel, template: Float[Tensor, "N 3"], motion: Motion, betas: Float[Tensor, "K"], dual: bool
) -> Penetration:
    state = model.state(motion.rotations, betas, motion.translation)
    pose = model.posed_by_dual_quaternions if dual else model.posed
    garment, bodies = [], []
    for start in range(0, len(motion), FRAMES_AT_ONCE):
        part = slice(start, start + FRAMES_AT_ONCE)
        garment.append(pose(template.expand(len(motion.translation[part]), -1, -1), state[part]))
        bodies.append(
            model.body.vertices(
                motion.rotations[part],
                betas,
                motion.translation[part],
                skinning="dual_quaternion" if dual else "linear",
            )
        )
    return penetration(torch.cat(bodies), model.body.faces, torch.cat(garment))


def regions_of(model: GarmentModel, points: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
    """The body region whose joints hold the most weight at each canonical point: an index into REGIONS."""
    weights = model.fields.at(points).weights
    joint_region = torch.tensor([_region(name) for name in model.body.joint_names])
    by_region = torch.stack([weights[:, joint_region == index].sum(dim=1) for index in range(len(REGIONS))], dim=1)
    return by_region.argmax(dim=1)


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
