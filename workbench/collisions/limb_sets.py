"""Which joints act on a garment together.  W~ at its vertices, kinematic tree -> sets of joints, one a limb.

What an arm does to a sleeve does not depend on the legs.  A network that sees the whole pose has to learn that from
the poses it is shown, and there are never enough: one that sees a limb and the trunk meets fewer strange poses.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

# Diffused weight above which a joint moves a vertex.  Others, the fingers of a body in a T-shirt, say nothing, but a
# network that saw them would believe what training motions do with them.
MOVES = 0.05
TOGETHER = 0.005  # share of the garment's vertices that two limbs move both, above which they act together


def limb_sets(weights: Float[Tensor, "N J"], parents: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Sets of joints, which may overlap and together hold every joint that says something of the garment.

    Joints that move it, and their children, are seen, but for the root.  The trunk is where they branch and what leads
    there; a limb is what hangs on it, or on the root.  A set is the trunk, a limb, and the limbs that move the same
    vertices; a limb that a set has taken in has none of its own, the widest come first.
    """
    moves = (weights.amax(dim=0) > MOVES).tolist()
    seen = [joint for joint in range(1, len(parents)) if moves[joint] or moves[parents[joint]]]
    trunk = _trunk(seen, parents)
    limbs = _limbs([joint for joint in seen if joint not in trunk], parents)
    moved = [weights[:, limb].sum(dim=1) > MOVES for limb in limbs]
    sets: list[tuple[int, ...]] = []
    taken: set[int] = set()
    for this in sorted(range(len(limbs)), key=lambda limb: -int(moved[limb].sum())):
        if this in taken:
            continue
        shared = [float((moved[this] & of_other).float().mean()) for of_other in moved]
        together = {this, *(other for other, share in enumerate(shared) if share > TOGETHER)}
        taken |= together
        sets.append(tuple(sorted(trunk.union(*(limbs[limb] for limb in together)))))
    return tuple(sets) or (tuple(seen),)


def _trunk(seen: Sequence[int], parents: Sequence[int]) -> set[int]:
    """Seen joints with two or more seen children, and their ancestors; without the root."""
    trunk: set[int] = set()
    for joint in seen:
        if sum(parents[child] == joint for child in seen) < 2:
            continue
        while joint > 0:
            trunk.add(joint)
            joint = parents[joint]
    return trunk


def _limbs(joints: Sequence[int], parents: Sequence[int]) -> list[list[int]]:
    """Joints by the limb that they are of; parents come before their children."""
    limbs: list[list[int]] = []
    limb_of: dict[int, list[int]] = {}
    for joint in joints:
        limb = limb_of.get(parents[joint])
        if limb is None:
            limb = []
            limbs.append(limb)
        limb.append(joint)
        limb_of[joint] = limb
    return limbs
