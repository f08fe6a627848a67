"""Skeleton: the joint tree of a body.  names, parents, rest_joints (J,3)  ->  lookups along the tree."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A joint tree with its rest joint positions.

    names: one unique name a joint.  parents: index of each joint's parent, -1 for the one root, which comes first;
    parents come before their children.  rest_joints (J,3): metres, at beta = 0, in the rest pose.
    Raises ValueError for anything that is not such a tree.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest_joints: Float[Tensor, "J 3"]

    def __post_init__(self) -> None:
        J = len(self.names)
        if len(self.parents) != J or tuple(self.rest_joints.shape) != (J, 3):
            raise ValueError(
                f"a skeleton of {J} names needs {J} parents and rest_joints ({J}, 3), but got {len(self.parents)} "
                f"parents and rest_joints {tuple(self.rest_joints.shape)}"
            )
        if J == 0:
            raise ValueError("a skeleton needs at least one joint, but got none")
        if len(set(self.names)) != J:
            repeated = sorted({name for name in self.names if self.names.count(name) > 1})
            raise ValueError(f"joint names must be unique, but these repeat: {', '.join(repeated)}")
        if self.parents[0] != -1 or any(not 0 <= parent < j for j, parent in enumerate(self.parents) if j > 0):
            raise ValueError(
                f"joint 0 must be the only root (parent -1) and parents must come before their children, "
                f"but parents are {self.parents}"
            )
        if not torch.isfinite(self.rest_joints).all():
            raise ValueError("rest_joints must be finite, but they hold NaN or infinity")

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Position of the joint called `name`; ValueError if there is none."""
        if name not in self.names:
            raise ValueError(f"no joint is called {name!r}; the skeleton has {', '.join(self.names)}")
        return self.names.index(name)

    def children(self, joint: int) -> tuple[int, ...]:
        """Joints whose parent is `joint`."""
        return tuple(j for j, parent in enumerate(self.parents) if parent == joint)

    def descendants(self, joint: int) -> tuple[int, ...]:
        """`joint` and everything below it, in joint order."""
        below = {joint}
        for j, parent in enumerate(self.parents):  # parents come first, so one pass is enough
            if parent in below:
                below.add(j)
        return tuple(sorted(below))

    @property
    def offsets(self) -> Float[Tensor, "J 3"]:
        """Rest vector from each joint's parent to the joint; zero at the root."""
        parents = torch.tensor([max(parent, 0) for parent in self.parents], device=self.rest_joints.device)
        return self.rest_joints - self.rest_joints[parents]

    def same_tree(self, other: "Skeleton") -> bool:
        """True if names and parents agree (rest positions may differ)."""
        return self.names == other.names and self.parents == other.parents
