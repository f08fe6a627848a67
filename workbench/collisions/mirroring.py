"""Left and right exchanged: CanonicalSet -> the same set with every training sequence also seen in a mirror.

Cloth on a symmetric body knows no left and right (beyond the paper, which does not say that it makes use of it): a
mirrored motion makes the mirrored garment, a second sequence for nothing.  The plane is x = 0.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.canonical_set import CanonicalSequence, CanonicalSet
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint

ACROSS = (-1.0, 1.0, 1.0)
SIDES = (("left_", "right_"), ("Left", "Right"), ("L", "R"))  # how names of joints begin
OFF = 8e-3  # metres: a surface is symmetric where each of its mirrored vertices lies so near to it


@dataclass(frozen=True, eq=False)
class GarmentMirror:
    """Where on the garment the mirror image of each vertex lies: X'_i = sum_k weights_ik ACROSS X_(corners_ik)."""

    corners: Int[Tensor, "N 3"]
    weights: Float[Tensor, "N 3"]

    @staticmethod
    def of(garment: Garment) -> "GarmentMirror | None":
        """None where the template is not its own mirror image, to OFF."""
        template = garment.vertices.float()
        surface = ClosestPoint(template.numpy(), garment.faces.int().numpy())
        found = surface.query((template * torch.tensor(ACROSS)).numpy())
        if found.distance.max() > OFF:
            return None
        return GarmentMirror(
            garment.faces.long()[torch.from_numpy(found.face).long()], torch.from_numpy(found.barycentric)
        )

    def __call__(self, X: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 3"]:
        """The mirror image of canonical garments, vertex for vertex."""
        corners = X[..., self.corners.to(X.device), :]
        return (self.weights.to(X)[..., None] * corners).sum(-2) * X.new_tensor(ACROSS)


@dataclass(frozen=True, eq=False)
class BodyMirror:
    """Which joint is which in a mirror."""

    joints: Int[Tensor, " J"]

    @staticmethod
    def of(body: Body) -> "BodyMirror | None":
        """None for a body that is not its own mirror image in every shape, to OFF."""
        names = body.joint_names
        joints = torch.tensor([names.index(_other_side(name, names)) for name in names])
        across = torch.tensor(ACROSS)
        moved = torch.cat([body.joint_template[None], body.joint_directions])
        apart = (moved[:, joints] * across - moved).abs().amax()
        surface = ClosestPoint(body.template.numpy(), body.faces.int().numpy())
        off = surface.query((body.template * across).numpy()).distance.max()
        return BodyMirror(joints) if max(float(apart), float(off)) <= OFF else None

    def rotations(self, rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B J 3 3"]:
        """theta of the mirrored pose: S R S, of the joint on the other side."""
        across = rotations.new_tensor(ACROSS)
        return rotations[..., self.joints.to(rotations.device), :, :] * across[:, None] * across

    def translation(self, translation: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Of the mirrored root."""
        return translation * translation.new_tensor(ACROSS)


def with_mirrored(data: CanonicalSet, body: Body) -> CanonicalSet:
    """The set, and each of its training sequences once more in a mirror, by the principal components of both; the set
    itself where garment or body are not symmetric."""
    of_garment, of_body = GarmentMirror.of(data.garment), BodyMirror.of(body)
    if of_garment is None or of_body is None:
        return data
    count, rank = len(data.mean), data.rank
    in_mirror = of_garment(data.mean)
    mean = (data.mean + in_mirror) / 2
    spanned = torch.cat([data.basis, of_garment(data.basis), (data.mean - mean)[None], (in_mirror - mean)[None]])
    axes, sizes = torch.linalg.qr(spanned.flatten(1).T / count**0.5)  # (3N,2R+2), (2R+2,2R+2)

    def seen(s: CanonicalSequence) -> CanonicalSequence:
        amounts = s.coefficients @ sizes[:, :rank].T + sizes[:, -2]
        return replace(s, coefficients=amounts)

    def mirrored(s: CanonicalSequence) -> CanonicalSequence:
        amounts = s.coefficients @ sizes[:, rank : 2 * rank].T + sizes[:, -1]
        rotations, translation = of_body.rotations(s.rotations), of_body.translation(s.translation)
        name = f"{s.motion_name} mirrored"
        return replace(s, coefficients=amounts, rotations=rotations, translation=translation, motion_name=name)

    sequences = [seen(s) for s in data.sequences] + [mirrored(s) for s in data.of_split("train")]
    amounts = torch.cat([s.coefficients[s.valid] for s in sequences if s.split == "train"])
    _, turn = torch.linalg.eigh((amounts.T @ amounts).double())
    turn = turn.flip(1).float()
    basis = (axes @ turn * count**0.5).T.unflatten(1, (-1, 3))
    turned = tuple(replace(s, coefficients=s.coefficients @ turn) for s in sequences)
    return replace(data, mean=mean, basis=basis.contiguous(), sequences=turned)


def _other_side(name: str, names: tuple[str, ...]) -> str:
    """The joint of the same name on the other side; the joint itself where there is none."""
    for left, right in SIDES:
        for mine, others in ((left, right), (right, left)):
            if name.startswith(mine) and others + name.removeprefix(mine) in names:
                return others + name.removeprefix(mine)
    return name
