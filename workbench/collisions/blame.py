"""Sec. 4-5: which stage made each collision.  the garment after each stage (T,N,3) -> a cause for each vertex.

The stages follow each other as in the paper: the simulation M_G (on its own body); X, projected (Eq. 9), decoded
(Eq. 13) and regressed (Eq. 18), on the constant body; the garment posed on the wearer (Eq. 7).  A vertex that collides
after the last stage is blamed on the stage after which it was first inside, counted back from the end without a break:
a stage whose fault a later one mended is not blamed for what a still later one breaks anew.

The body is blamed instead where no garment could be free: the vertex lies in two layers of the body at once, or the
skin that it lies on in canonical space is, in this pose, buried in another limb.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.collisions.penetration import Penetration, body_of, penetration
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.layer_count import LayerCount
from workbench.geometry.mesh import face_normals

STAGES = ("simulation data", "projection", "decoder", "regressor", "unprojection")
BODY_OVERLAP = "body overlap"
CAUSES = STAGES + (BODY_OVERLAP,)
FREE = -1
SKIN = 1e-3  # metres above the skin where it is asked whether another limb is there: ours, above rounding, below cloth


@dataclass(frozen=True, eq=False)
class StageArrays:
    """The garment after each stage, of those that ran; metres.  Give at least one; every one has the same T and N.

    `simulated` and `posed` go with the body they were made on (one frame, or T); `projected`, `decoded` and
    `regressed` are canonical and go with `canonical_body`.  _ is T and N, whose agreement is checked below.
    """

    body_faces: Int[Tensor, "F 3"]
    simulated: Float[Tensor, "_ _ 3"] | None = None
    simulated_body: Float[Tensor, "A V 3"] | None = None
    canonical_body: Float[Tensor, "V 3"] | None = None
    projected: Float[Tensor, "_ _ 3"] | None = None
    decoded: Float[Tensor, "_ _ 3"] | None = None
    regressed: Float[Tensor, "_ _ 3"] | None = None
    posed: Float[Tensor, "_ _ 3"] | None = None
    posed_body: Float[Tensor, "B V 3"] | None = None

    def __post_init__(self) -> None:
        given = {name: garment for name, garment, _ in self._pairs() if garment is not None}
        if not given:
            raise ValueError(f"there is no stage to blame: give the garment after at least one of {', '.join(STAGES)}")
        shapes = {tuple(garment.shape) for garment in given.values()}
        if len(shapes) > 1:
            told = ", ".join(f"{name} {tuple(garment.shape)}" for name, garment in given.items())
            raise ValueError(f"stages must hold the same frames and vertices, got {told}")
        lacking = [name for name, garment, body in self._pairs() if garment is not None and body is None]
        if lacking:
            raise ValueError(f"the body is missing for {', '.join(lacking)}: give the one that stage is made on")

    def _pairs(self) -> list[tuple[str, Tensor | None, Tensor | None]]:
        constant = None if self.canonical_body is None else self.canonical_body[None]
        garments = (self.simulated, self.projected, self.decoded, self.regressed, self.posed)
        bodies = (self.simulated_body, constant, constant, constant, self.posed_body)
        return list(zip(STAGES, garments, bodies))

    def given(self) -> list[tuple[str, Tensor, Tensor]]:
        """(name, garment, body) of each stage that ran, in order."""
        return [
            (name, garment, body) for name, garment, body in self._pairs() if garment is not None and body is not None
        ]


@dataclass(frozen=True, eq=False)
class Blame:
    """The cause of every collision after the last stage."""

    cause: Int[Tensor, "T N"]  # index into CAUSES; FREE where the vertex does not collide after the last stage
    inside: Bool[Tensor, "S T N"]  # after each stage that ran
    stages: tuple[str, ...]  # the stages that ran

    @property
    def counts(self) -> dict[str, int]:
        """Colliding vertices of all frames by cause; stages that did not run cannot be blamed and are left out."""
        return {name: int((self.cause == CAUSES.index(name)).sum()) for name in (*self.stages, BODY_OVERLAP)}

    @property
    def mended(self) -> dict[str, int]:
        """Vertices inside after a stage and free after the next: faults that were undone on the way."""
        pairs = zip(self.stages, self.inside[:-1], self.inside[1:])
        return {name: int((before & ~after).sum()) for name, before, after in pairs}


def blame(stages: StageArrays) -> Blame:
    """Inside tests after every stage, then the cause of what collides after the last one.

    Errors: ValueError as `penetration`'s (frame counts, NaN, an open body).
    """
    given = stages.given()
    found = [penetration(body, stages.body_faces, garment) for _, garment, body in given]
    inside = torch.stack([f.inside for f in found])
    overlap = torch.stack([_no_room(stages, name, f) for (name, _, _), f in zip(given, found)])
    unbroken = inside.flip(0).long().cumprod(dim=0).flip(0)  # inside after this stage and all later ones
    first = len(given) - unbroken.sum(dim=0)  # the stage after which that began
    colliding = inside[-1]
    of_stage = torch.tensor([STAGES.index(name) for name, _, _ in given])
    began = first.clamp(max=len(given) - 1)
    body_fault = overlap.gather(0, began[None])[0]
    cause = torch.where(body_fault, CAUSES.index(BODY_OVERLAP), of_stage[began])
    return Blame(torch.where(colliding, cause, FREE), inside, tuple(name for name, _, _ in given))


def _no_room(stages: StageArrays, name: str, found: Penetration) -> Bool[Tensor, "T N"]:
    """Colliding vertices for which this pose of the body leaves no room."""
    canonical = [X for X in (stages.projected, stages.decoded, stages.regressed) if X is not None]
    if not canonical or stages.canonical_body is None:
        return found.overlap
    if name == "unprojection" and stages.posed_body is not None:
        return found.overlap | _buried(stages, stages.canonical_body, canonical[-1], stages.posed_body, found.inside)
    if name == "simulation data" and stages.simulated_body is not None:
        return found.overlap | _buried(stages, stages.canonical_body, canonical[0], stages.simulated_body, found.inside)
    return found.overlap


def _buried(
    stages: StageArrays,
    canonical_body: Float[Tensor, "V 3"],
    X: Float[Tensor, "T N 3"],
    posed_body: Float[Tensor, "B V 3"],
    inside: Bool[Tensor, "T N"],
) -> Bool[Tensor, "T N"]:
    """Of the vertices `inside`, those whose skin (the closest point to X on the constant body) lies in another limb."""
    faces = stages.body_faces.numpy()
    skin, count = ClosestPoint(canonical_body.numpy(), faces), LayerCount(posed_body[0].numpy(), faces)
    buried = torch.zeros_like(inside)
    for frame in inside.any(dim=1).nonzero()[:, 0].tolist():
        hit = inside[frame].nonzero()[:, 0]
        body = body_of(posed_body, frame)
        nearest = skin.query(X[frame, hit].numpy())
        normals = face_normals(body, stages.body_faces)[torch.from_numpy(nearest.face)].numpy()
        count.refit(body.numpy())
        above = nearest.interpolate(body.numpy(), faces) + SKIN * normals
        buried[frame, hit] = torch.from_numpy(count(above) >= 1)
    return buried


def blame_report(found: Blame) -> dict[str, Any]:
    """The figures of a blame, ready for JSON."""
    total = int((found.cause != FREE).sum())
    return {
        "stages": list(found.stages),
        "colliding": total,
        "by_cause": found.counts,
        "by_cause_percent": {name: 100 * count / total if total else 0.0 for name, count in found.counts.items()},
        "inside_after_each_stage": {name: int(i.sum()) for name, i in zip(found.stages, found.inside)},
        "mended_by_the_next_stage": found.mended,
        "by_frame": {
            name: (found.cause == CAUSES.index(name)).sum(dim=1).tolist() for name in (*found.stages, BODY_OVERLAP)
        },
    }
