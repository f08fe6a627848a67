"""Beyond the paper: what patches of a garment see of the body's limbs.  theta (J,3,3), beta (K) -> (P,F).

Whether cloth ends inside a limb depends on where the limb is from the cloth, not on the angles of the joints between
them: a thigh at the belly is the same sight whether hip or spine brought it there, and whether one stands or rolls.
Each patch has an anchor, which Eq. 7 poses with the diffused fields at rest; every bone is seen from there, in the
anchor's own frame, and counts the less the farther it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from workbench.body.model import Body
from workbench.body.skinning import blended_affine, forward_kinematics
from workbench.collisions.diffused_body import DiffusedFields

FAR = 0.2  # metres: a bone so far away counts exp(-1/2)
SHORTEST = 0.04  # bones that are shorter, in heights of the body, are no limbs
PER_BONE = 13  # nearness, the nearest point of the bone (3), how it is turned (9)


@dataclass(frozen=True, eq=False)
class Seen:
    """Of P anchors and S bones, with the root unturned and where it rests."""

    places: Float[Tensor, "*B P 3"]  # of the anchors, posed
    apart: Float[Tensor, "*B P S 3"]  # the way from there to the nearest point of each bone
    near: Float[Tensor, "*B P S"]  # g: how much the bone counts
    frames: Float[Tensor, "*B P 3 3"]  # the blended rotations of the anchors
    turns: Float[Tensor, "*B S 3 3"]  # the rotations of the bones

    def features(self) -> Float[Tensor, "*B P F"]:
        """Bone by bone, in the anchor's frame: g; g times the way over FAR; g times (the bone's rotation - I)."""
        own = self.frames.mT[..., None, :, :] @ self.turns[..., None, :, :, :] - torch.eye(3)
        one = torch.ones_like(self.near)[..., None]
        told = torch.cat([one, self.apart @ self.frames / FAR, own.flatten(-2)], dim=-1)  # A^T apart, for rows
        return (self.near[..., None] * told).flatten(-2)


class LimbSight(nn.Module):
    """What P anchors see; all that is needed of body and fields lies in buffers.

    anchors (P 3), offsets (K, P 3): B~s there; weights (P,J): W~ there; joints (J 3), joint_directions (K, J 3);
    ends (S): the joints at which bones end, which begin at the parents.
    """

    anchors: Tensor
    offsets: Tensor
    weights: Tensor
    joints: Tensor
    joint_directions: Tensor
    ends: Tensor

    def __init__(self, parents: Sequence[int], patches: int, shapes: int, bones: int):
        super().__init__()
        self.parents = tuple(parents)
        sizes = {
            "anchors": (3 * patches,),
            "offsets": (shapes, 3 * patches),
            "weights": (patches, len(parents)),
            "joints": (3 * len(parents),),
            "joint_directions": (shapes, 3 * len(parents)),
            "ends": (bones,),
        }
        for name, size in sizes.items():
            self.register_buffer(name, torch.zeros(size))

    @staticmethod
    @torch.no_grad()
    def of(body: Body, fields: DiffusedFields, anchors: Float[Tensor, "P 3"]) -> "LimbSight":
        """Anchors in canonical space see the limbs of this body."""
        rest, height = body.joint_template, float(body.template[:, 2].max() - body.template[:, 2].min())
        length = (rest - rest[torch.tensor(body.parents).clamp_min(0)]).norm(dim=-1)
        ends = torch.nonzero(length > SHORTEST * height)[:, 0]
        shapes = torch.eye(body.shape_count)
        offsets = fields.rigging(
            anchors.expand(len(shapes), -1, -1), shapes, torch.zeros(len(shapes), len(body.pose_directions))
        ).offset
        sight = LimbSight(body.parents, len(anchors), len(shapes), len(ends))
        found = {
            "anchors": anchors.flatten(),
            "offsets": offsets.flatten(1),
            "weights": fields.weights(anchors),
            "joints": rest.flatten(),
            "joint_directions": body.joint_directions.flatten(1),
            "ends": ends,
        }
        for name, buffer in sight.named_buffers():
            buffer.copy_(found[name])
        return sight

    def checked(self) -> "LimbSight":
        """This, if joints hang on joints before them, and bones end at joints that hang on one; else ValueError."""
        hanging = [0 <= parent < joint for joint, parent in enumerate(self.parents)]
        known = {joint for joint, hangs in enumerate(hanging) if hangs}
        if not all(hangs or self.parents[joint] == -1 for joint, hangs in enumerate(hanging)):
            raise ValueError(f"joints that hang on none before them: parents {list(self.parents)}")
        if not known.issuperset(self.ends.tolist()):
            raise ValueError(f"bones that end at no joint: {self.ends.tolist()}")
        return self

    @property
    def size(self) -> int:
        """F: what a patch sees, in numbers."""
        return PER_BONE * self.ends.numel()

    @property
    def shapes(self) -> int:
        """K"""
        return len(self.offsets)

    def bones(self) -> tuple[Tensor, Tensor]:
        """The joints at which the bones begin and end."""
        ends = self.ends.long()
        return torch.tensor(self.parents)[ends], ends

    def at_rest(self, betas: Float[Tensor, "*B K"]) -> tuple[Float[Tensor, "*B J 3"], Float[Tensor, "*B P 3"]]:
        """Joints and anchors of a shape that is not posed."""
        joints, anchors = self.joints + betas @ self.joint_directions, self.anchors + betas @ self.offsets
        return joints.unflatten(-1, (-1, 3)), anchors.unflatten(-1, (-1, 3))

    @torch.no_grad()
    def look(self, rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "*B K"]) -> Seen:
        """Every bone from every anchor.  How the body is turned as a whole does not matter."""
        turned = rotations.clone()
        turned[..., 0, :, :] = torch.eye(3)
        joints, anchors = self.at_rest(betas)
        pose = forward_kinematics(turned, joints, self.parents)
        A, t = blended_affine(self.weights, pose.transforms)
        places = (A @ anchors[..., None])[..., 0] + t
        starts, ends = self.bones()
        first = pose.joints[..., None, starts, :]
        along, to = pose.joints[..., None, ends, :] - first, places[..., None, :] - first
        share = ((to * along).sum(-1) / along.square().sum(-1)).clamp(0, 1)
        apart = share[..., None] * along - to
        near = torch.exp(-0.5 * apart.square().sum(-1) / FAR**2)
        return Seen(places, apart, near, A, pose.transforms.rotation[..., starts, :, :])

    def forward(self, rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B P F"]:
        """What is seen, in numbers."""
        return self.look(rotations, betas).features()
