"""What a corrective learns from: motions, chance -> poses cleared for random shapes, with the regressor's latents.

Clearing takes seconds a motion and does not depend on the garment: each cleared motion is kept, named by what made it.
Motions need not be cleared where there are many of them: those of their poses are taken that leave cloth room.
"""

import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from workbench.body.model import Body
from workbench.collisions.penetration import penetration
from workbench.collisions.regressor import Regressor
from workbench.geometry.mesh import vertex_normals
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.store import Store, code_version

SHAPE_CUT = 2.5  # standard deviations: random shapes are cut there
MOST_OVERLAP = 0.002  # share of a garment's vertices where the body may overlap itself
LOOKED_AT = 4  # for which one vertex in so many is looked at


@dataclass(frozen=True)
class Jitter:
    """Standard deviations of what is added to the poses, shapes and latents whenever they are looked at; ours.

    A few hundred motions on as many shapes are learned by heart: without this, 6000 steps on the T-shirt left 0.098 %
    of the vertices of validation motions inside, more than 2000 had (0.075 %).  The body is posed with what is added,
    so the loss stays true; that limbs are clear of it is kept by the 30 mm that clearing leaves.
    """

    pose: float = 0.04  # radians, of each rotation vector but the root's
    shape: float = 0.5  # of each component of beta
    latent: float = 0.2


@dataclass(frozen=True, eq=False)
class WornPoses:
    """Poses of cleared motions, the shapes that wear them, and what the regressor says of them."""

    rotations: Float[Tensor, "M J 3 3"]
    betas: Float[Tensor, "M K"]
    latents: Float[Tensor, "M L"]

    def __len__(self) -> int:
        return len(self.rotations)

    def __getitem__(self, index: Tensor) -> "WornPoses":
        return WornPoses(self.rotations[index], self.betas[index], self.latents[index])

    def jittered(self, jitter: Jitter, generator: torch.Generator) -> "WornPoses":
        """The same with a little chance in everything but the root's rotation."""
        turns = jitter.pose * torch.randn(self.rotations.shape[:-1], generator=generator)
        turns[..., 0, :] = 0.0
        shapes, latents = (torch.randn(x.shape, generator=generator) for x in (self.betas, self.latents))
        return WornPoses(
            self.rotations @ axis_angle_to_matrix(turns),
            (self.betas + jitter.shape * shapes).clamp(-SHAPE_CUT, SHAPE_CUT),
            self.latents + jitter.latent * latents,
        )

    @staticmethod
    def joined(parts: Sequence["WornPoses"]) -> "WornPoses":
        """All poses of several sets, in their order."""
        return WornPoses(
            torch.cat([part.rotations for part in parts]),
            torch.cat([part.betas for part in parts]),
            torch.cat([part.latents for part in parts]),
        )


@dataclass(frozen=True, eq=False)
class Wearer:
    """Dresses motions in random shapes.  `shapes` of them a motion, drawn from `seed` and the motion's name."""

    body: Body
    regressor: Regressor
    shapes: int
    every: int  # frames: one in so many is kept
    seed: int
    kept: Path  # the folder of cleared motions

    def __call__(self, motions: Sequence[Motion], shapes: int | None = None) -> WornPoses:
        """Every motion on its shapes (or on so many of them), cleared for each; what was cleared before is read."""
        worn = [(motion, betas) for motion in motions for betas in self.shapes_of(motion)[:shapes]]
        with ThreadPoolExecutor(2) as pool:
            made = pool.map(lambda pair: self.worn(*pair), worn)
            return WornPoses.joined(list(tqdm(made, total=len(worn), desc="clear for random shapes", mininterval=5.0)))

    def uncleared(self, motions: Sequence[Motion]) -> WornPoses:
        """Every motion as it is, on the first of its shapes."""
        made = (self.dressed(motion, self.shapes_of(motion)[0]) for motion in motions)
        return WornPoses.joined(list(tqdm(made, total=len(motions), desc="dress uncleared motions", mininterval=5.0)))

    def shapes_of(self, motion: Motion) -> Float[Tensor, "S K"]:
        """The shapes that wear a motion: the same for every garment."""
        generator = torch.Generator().manual_seed(self.seed + zlib.crc32(motion.name.encode()))
        return torch.randn(self.shapes, self.body.shape_count, generator=generator).clamp(-SHAPE_CUT, SHAPE_CUT)

    def worn(self, motion: Motion, betas: Float[Tensor, " K"]) -> WornPoses:
        """One motion on one shape, cleared for it."""
        return self.dressed(cleared_for(motion, betas, self.body, Store(self.kept)), betas)

    @torch.no_grad()
    def dressed(self, motion: Motion, betas: Float[Tensor, " K"]) -> WornPoses:
        latents = self.regressor(motion.rotations[None], motion.translation[None], betas[None])[0]
        index = torch.arange(0, len(motion), self.every)
        return WornPoses(motion.rotations[index], betas.expand(len(index), -1), latents[index])


@torch.no_grad()
def with_room(
    worn: WornPoses,
    garments: Callable[[WornPoses], Float[Tensor, "B N 3"]],
    body: Body,
    gap: float = 0.0,
    most_overlap: float = MOST_OVERLAP,
) -> WornPoses:
    """The poses in which the body keeps `gap` metres from itself where the garment hangs, and does not overlap: at no
    more than a share of the vertices."""
    free = []
    for part in torch.arange(len(worn)).split(64):
        some = worn[part]
        bodies = body.vertices(some.rotations, some.betas)
        if gap:
            bodies = bodies + gap / 2 * vertex_normals(bodies, body.faces)
        overlap = penetration(bodies, body.faces, garments(some)[:, ::LOOKED_AT]).overlap.float().mean(dim=1)
        free.append(some[torch.nonzero(overlap <= most_overlap)[:, 0]])
    return WornPoses.joined(free)


def cleared_for(motion: Motion, betas: Float[Tensor, " K"], body: Body, store: Store) -> Motion:
    """A motion cleared for a shape, made once and kept in `store`."""
    seen = {"rotations": motion.rotations, "translation": motion.translation, "fps": motion.fps}
    made_by = {**seen, "betas": betas, "body": (body.template, body.shape_directions)}

    def write(path: Path) -> None:
        motion.cleared(body, betas=betas).save(path)

    name = "".join(letter if letter.isalnum() else "_" for letter in motion.name) or "motion"
    return Motion.load(store.make(name, made_by, write, code_version("workbench.motion_clearing")).path)
