"""Beyond the paper: what the pose does to X so that Eq. 7 does not fold it into the body.  theta, beta, x_bar -> (N,3).

Eq. 16 sees only the constant canonical body.  Where limbs close, Eq. 7 folds space, and a canonical garment that
touches nothing ends inside the posed body (facts.md 9).  25 latents cannot say where: pushing the regressor's own
output (tried before) took a third of the collisions off and cost 2.4 mm of vertex error.  This network adds an offset
C(theta, beta, x_bar) to D(x_bar): each of many overlapping patches mixes a basis of its own, by what it sees of the
limbs about it (`limb_sight`).  It learns from `ContactPlanes` alone, on training motions worn by random shapes, cleared
for them or with room; no ground truth.  Eq. 16's hinge keeps X + C out of the canonical body, penalties on C, on its
Laplacian and on what it does to edges keep it away from where it is not needed.
"""

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF, GridSDF
from workbench.collisions.canonical_set import CanonicalSet
from workbench.collisions.contact_planes import ContactPlanes
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.limb_sight import LimbSight
from workbench.collisions.posed_distance import PosedDistance
from workbench.collisions.regressor import Regressor
from workbench.collisions.subspace import LATENTS, Subspace
from workbench.collisions.worn_poses import Jitter, Wearer, WornPoses, with_room
from workbench.formats import load_motion, motion_files
from workbench.geometry.laplacian import apply_laplacian, umbrella_laplacian
from workbench.geometry.patches import Patches
from workbench.learning.batches import random_rows
from workbench.learning.fit import FitConfig, fit
from workbench.learning.network_file import read_network, write_network
from workbench.learning.scalar_log import ScalarLog, read_curves
from workbench.motion import Motion

log = logging.getLogger(__name__)

FORMAT = "corrective-2"
TRAIN_IT = "train it with `workbench train corrective`"
MILLI = 1e3
FIRST_GAIN = 4.0  # how far the principal directions of the needed corrections reach at amounts of 1
FIRST_OWN = 0.5  # standard deviation of the biases by which patches differ at first
ROOM = 0.016  # metres that uncleared poses must leave between limbs where the garment hangs
FOLDED = 0.02  # share of the vertices where a body that is folded up may overlap itself, once it is cleared
# Metres, root mean square over the garment, that an offset may have: a guard.  21 clips of mocap, errors of capture and
# getting up from the floor among them, ask for up to 109 mm of the T-shirt; walking for 20
REACH = 0.1
EASY_STRETCH = 0.4  # of an edge's length at rest, which C may add or take for nothing
EDGES = 4096  # of the garment, that each step looks at
FEATURE_SCALE = 0.3  # of beta and x_bar beside what is seen


@dataclass(frozen=True)
class CorrectiveWeights:
    """Terms in millimetres (`size`: square millimetres); ours.

    These were compared on validation motions; those of what ships were chosen after figures of test motions (README).
    """

    hinge: float = 50.0  # of the depth in posed space
    canonical: float = 50.0  # of Eq. 16's hinge on X + C
    # |C|^2: square, so that no vertex goes far.  Of an earlier network, which saw the rotations of joints, 1,500 steps
    # over 6,500 of the T-shirt's poses, looked at once: 0.003 left 0.51 % inside on loosened poses and moved those of
    # validation by 4.9 mm, 0.001 left 0.42 % and 6.5 mm
    size: float = 0.001
    laplacian: float = 0.5  # |Delta C|_1
    stretch: float = 10.0  # square of what C adds to an edge beyond EASY_STRETCH of its length; sleeves showed spikes
    posed_clearance: float = 4e-3  # metres; in the same runs 3, 5 and 8 mm left 0.51, 0.46 and 0.36 %
    canonical_clearance: float = 2e-3  # metres, epsilon of Eq. 16


@dataclass(frozen=True)
class TrainCorrectiveConfig:
    """`workbench train corrective`: after subspace and regressor, from the training set's motions alone."""

    garment: str = "tshirt"
    # A set of canonical garments (.npz), for its motions; the shipped one when absent.
    data: Path | None = None
    # The folder with GARMENT-subspace and GARMENT-regressor, also written to.
    out: Path = Path("out/models")
    # Folders of further motion files to learn from: no garment was ever simulated on them, and none need be.
    motions: tuple[Path, ...] = ()
    # The same, but not cleared: those of their poses are learned from that leave cloth room.
    uncleared: tuple[Path, ...] = ()
    # The same of bodies that are folded up, cleared for one shape each: there skin stays on skin, and in it.
    close: tuple[Path, ...] = ()
    # A corrective to begin with, for other weights or motions than it was trained with; rank and width are its own.
    start: Path | None = None
    patches: int = 64  # of the garment, overlapping
    rank: int = 24  # offsets that are mixed in each
    width: int = 256  # of the layers that say how much of each
    weights: CorrectiveWeights = CorrectiveWeights()  # of the terms of the loss
    jitter: Jitter = Jitter()  # what is added to poses, shapes and latents, at every look
    shapes_a_motion: int = 2  # random shapes that wear each training motion
    every: int = 3  # frames of it: one in so many is learned from
    first_frames: int = 240  # whose needed corrections give the first basis
    round_poses: int = 1000  # jittered poses whose contacts are looked at ...
    round_steps: int = 600  # ... and learned from for so many steps
    batch: int = 32  # poses a step
    fit: FitConfig = field(default_factory=lambda: FitConfig(steps=20_000, learning_rate=2e-3, clip_norm=50.0))
    seed: int = 0


class PosedCorrective(nn.Module):
    """C(theta, beta, x_bar): each patch, from what it sees of the limbs, mixes its own basis.

    Two dense layers, ReLU and LayerNorm each, whose weights all patches share; a patch has biases, amounts and a basis
    of its own.
    """

    def __init__(
        self,
        garment_name: str,
        patches: Patches,
        sight: LimbSight,
        basis: Float[Tensor, "R P3n"],
        width: int = 256,
        generator: torch.Generator | None = None,
    ):
        """basis: of each patch, amounts -> flattened offsets, millimetres; beside each other."""
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        self.garment_name, self.patches, self.sight = garment_name, patches, sight
        count = len(patches)

        def dense(inputs: int) -> nn.Parameter:
            weight = torch.empty(width, inputs)
            nn.init.kaiming_uniform_(weight, nonlinearity="relu", generator=generator)
            return nn.Parameter(weight.T.contiguous())

        def own() -> nn.Parameter:
            return nn.Parameter(FIRST_OWN * torch.randn(count, width, generator=generator))

        self.first, self.second = dense(sight.size + sight.shapes + LATENTS), dense(width)
        self.first_own, self.second_own = own(), own()
        self.first_norm, self.second_norm = nn.LayerNorm(width, eps=1e-3), nn.LayerNorm(width, eps=1e-3)
        self.last = nn.Parameter(torch.zeros(count, width, len(basis)))  # it begins by correcting nothing
        self.last_own = nn.Parameter(torch.zeros(count, len(basis)))
        self.basis = nn.Parameter(basis.clone())
        self.story: dict = {}

    @property
    def vertex_count(self) -> int:
        return self.patches.point_count

    @property
    def joints(self) -> int:
        return len(self.sight.parents)

    @property
    def shapes(self) -> int:
        return self.sight.shapes

    def forward(
        self, rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "*B K"], latent: Float[Tensor, "*B L"]
    ) -> Float[Tensor, "*B N 3"]:
        """The offset of X, metres, canonical space; the root's rotation does not matter."""
        offset = self.unbounded(rotations, betas, latent)
        return offset * within_reach(offset)[..., None, None]

    def unbounded(
        self, rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "*B K"], latent: Float[Tensor, "*B L"]
    ) -> Float[Tensor, "*B N 3"]:
        """The same before it is held to REACH: what training keeps small."""
        of_all = FEATURE_SCALE * torch.cat([betas, latent], dim=-1)
        first, common = self.first.split([self.sight.size, of_all.shape[-1]])
        hidden = self.sight(rotations, betas) @ first + (of_all @ common)[..., None, :] + self.first_own
        hidden = self.first_norm(torch.relu(hidden)) @ self.second + self.second_own
        hidden = self.second_norm(torch.relu(hidden))
        of_patches = hidden.reshape(-1, *hidden.shape[-2:]).transpose(0, 1)  # (P,B,W): `last` is not copied for each B
        amounts = (of_patches @ self.last).transpose(0, 1) + self.last_own
        return self.mixed(amounts.reshape(*hidden.shape[:-1], -1)) / MILLI

    def mixed(self, amounts: Float[Tensor, "*B P R"]) -> Float[Tensor, "*B N 3"]:
        """Offsets of amounts, millimetres."""
        count, rank = amounts.shape[-2:]
        basis = self.basis.unflatten(1, (count, -1)).transpose(0, 1)  # (P,R,3n)
        values = amounts.reshape(-1, count, rank).transpose(0, 1) @ basis  # (P,B,3n)
        offsets = self.patches.spread(values.transpose(0, 1).unflatten(-1, (-1, 3)))
        return offsets.reshape(*amounts.shape[:-2], *offsets.shape[-2:])

    def save(self, path: Path) -> None:
        """The parameters, with what made them; the basis as int8, a hundredth or two of an offset."""
        metadata = {
            "format": FORMAT,
            "garment": self.garment_name,
            "parents": json.dumps(self.sight.parents),
            "story": json.dumps(self.story),
        }
        patches = {"patches.vertices": self.patches.vertices.int(), "patches.windows": self.patches.windows.half()}
        write_network(self, path, metadata, coarse={"basis": 0}, beside=patches)

    @staticmethod
    def load(path: str | Path) -> "PosedCorrective":
        """Read what `save` wrote.  Raises FileNotFoundError, or ValueError for a damaged or foreign file."""
        found = read_network(Path(path), TRAIN_IT)
        metadata, tensors = found.metadata, found.tensors
        if metadata.get("format") != FORMAT:
            raise ValueError(
                f"{path} is no corrective (format {metadata.get('format')!r}, expected {FORMAT!r}); {TRAIN_IT}"
            )
        try:
            basis, (count, width) = tensors["basis"], tensors["first_own"].shape
            places, windows = (tensors.pop(f"patches.{name}") for name in ("vertices", "windows"))
            patches = Patches(places.long(), windows).checked(basis.shape[1] // 3)
            bones, shapes = len(tensors["sight.ends"]), len(tensors["sight.offsets"])
            sight = LimbSight(json.loads(metadata["parents"]), count, shapes, bones)
            corrective = PosedCorrective(metadata["garment"], patches, sight, torch.zeros_like(basis), width)
            corrective.load_state_dict(tensors)
            corrective.sight.checked()
        except (KeyError, ValueError, RuntimeError) as error:
            what = " ".join(str(error).split())  # torch tells it in several lines
            raise ValueError(f"network {path} is damaged ({what}); {TRAIN_IT}") from error
        corrective.story = json.loads(metadata["story"])
        return corrective.eval()

    @staticmethod
    def beside(folder: Path, garment_name: str) -> "PosedCorrective | None":
        """The corrective of a garment in a folder of networks, if there is one."""
        path = folder / f"{garment_name}-corrective.safetensors"
        return PosedCorrective.load(path) if path.is_file() else None


def within_reach(offset: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B"]:
    """What an offset is multiplied with, so that its root mean square is at most REACH.

    Poses that no body can take, as errors of a capture are, would else tear the garment to pieces.
    """
    size = offset.square().sum(-1).mean(-1)
    return REACH * size.clamp_min(REACH**2).rsqrt()


@dataclass(frozen=True, eq=False)
class CorrectiveTraining:
    """One run: data, the networks that are done, the loss."""

    config: TrainCorrectiveConfig
    data: CanonicalSet
    subspace: Subspace
    regressor: Regressor
    model: GarmentModel
    sdf: BodySDF
    start: PosedCorrective | None = None

    @staticmethod
    def of(config: TrainCorrectiveConfig) -> "CorrectiveTraining":
        data = CanonicalSet.load(config.data) if config.data else CanonicalSet.shipped(config.garment)
        name = data.garment_name
        subspace = Subspace.load(config.out / f"{name}-subspace.safetensors")
        regressor = Regressor.load(config.out / f"{name}-regressor.safetensors")
        model = GarmentModel(Body.default(), GridFields.default())
        start = None
        if config.start is not None:
            start = PosedCorrective.load(config.start).train()
            _check_start(start, name, model.body, config.start)
        return CorrectiveTraining(config, data, subspace, regressor, model, GridSDF.default(), start)

    @cached_property
    def distance(self) -> PosedDistance:
        return PosedDistance(self.model)

    @cached_property
    def laplacian(self) -> Float[Tensor, "N N"]:
        return umbrella_laplacian(self.data.garment.faces, len(self.data.mean))

    def wear(self, split: str) -> WornPoses:
        """The motions of a split on random shapes; training also takes those of `motions`, `uncleared` and `close`."""
        config, body, fps = self.config, self.model.body, self.data.fps
        motions = [
            Motion(s.rotations, s.translation, fps, body.skeleton, s.motion_name) for s in self.data.of_split(split)
        ]
        if split == "train":
            motions += _motions_in(config.motions, body)
        seed = config.seed + {"train": 3, "validation": 5}[split]
        kept = config.out / "work" / "cleared"
        wearer = Wearer(body, self.regressor, config.shapes_a_motion, config.every, seed, kept)
        worn = with_room(wearer(motions), self.garments, body)
        if split == "train" and config.uncleared:
            more = wearer.uncleared(_motions_in(config.uncleared, body))
            worn = WornPoses.joined([worn, with_room(more, self.garments, body, ROOM)])
        if split == "train" and config.close:
            more = wearer(_motions_in(config.close, body), shapes=1)
            worn = WornPoses.joined([worn, with_room(more, self.garments, body, most_overlap=FOLDED)])
        log.info("%d poses of the %s motions", len(worn), split)
        return worn

    def garments(self, worn: WornPoses) -> Float[Tensor, "B N 3"]:
        """Posed, as the regressor alone has them."""
        return self.model.posed(self.subspace.decode(worn.latents), self.model.state(worn.rotations, worn.betas))

    def contacts(self, corrective: PosedCorrective, worn: WornPoses) -> ContactPlanes:
        """What the garments touch, as they are corrected now."""
        return ContactPlanes.of(worn, self.subspace.decode, corrective, self.distance, self.sdf)

    def needed(self, worn: WornPoses) -> Float[Tensor, "B N 3"]:
        """What would bring each vertex that is too near to the clearance: A^T (c - d) n, in canonical space."""
        with torch.no_grad():
            X = self.subspace.decode(worn.latents)
            local = self.model.local_map(X, self.model.state(worn.rotations, worn.betas))
            bodies = self.model.body.vertices(worn.rotations, worn.betas)
        posed = local.posed(X).requires_grad_(True)
        distance = self.distance.between(posed, bodies)
        (away,) = torch.autograd.grad(distance.sum(), posed)
        short = (self.config.weights.posed_clearance - distance.detach()).clamp_min(0.0)
        return (local.rotation.mT @ (short[..., None] * away)[..., None])[..., 0]

    def first_basis(self, worn: WornPoses, patches: Patches) -> Float[Tensor, "R P3n"]:
        """Principal directions, on each patch, of the needed corrections of some frames; millimetres."""
        generator = torch.Generator().manual_seed(self.config.seed + 1)
        some = torch.randperm(len(worn), generator=generator)[: self.config.first_frames]
        needed = torch.cat([self.needed(worn[part]) for part in some.split(16)])
        of_patches = needed[:, patches.vertices].transpose(0, 1).flatten(2)  # (P,F,3n)
        _, size, directions = torch.linalg.svd(of_patches, full_matrices=False)
        rank = min(self.config.rank, size.shape[1])
        scaled = directions[:, :rank] * (size[:, :rank, None] / len(needed) ** 0.5 + 1e-6)
        return MILLI * FIRST_GAIN * scaled.transpose(0, 1).flatten(1)

    def begin(self, worn: WornPoses) -> PosedCorrective:
        """What training begins with: a corrective that corrects nothing, or `start`."""
        if self.start is not None:
            return self.start
        config, body = self.config, self.model.body
        mean = self.data.mean.reshape(-1, 3)
        patches = Patches.of(mean, config.patches)
        sight = LimbSight.of(body, self.model.fields, patches.centres(mean))
        basis, chance = self.first_basis(worn, patches), torch.Generator().manual_seed(config.seed)
        return PosedCorrective(self.data.garment_name, patches, sight, basis, config.width, chance)

    @cached_property
    def edges(self) -> tuple[Int[Tensor, "E 2"], Float[Tensor, " E"]]:
        """Of the garment, and how long they are at rest, millimetres."""
        faces, rest = self.data.garment.faces, self.data.garment.rest_vertices
        sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
        edges = torch.unique(sides, dim=0).long()
        return edges, MILLI * (rest[edges[:, 0]] - rest[edges[:, 1]]).norm(dim=-1)

    def stretch(self, offset: Float[Tensor, "B N 3"], generator: torch.Generator) -> Float[Tensor, ""]:
        """Mean square of what C does to edges beyond EASY_STRETCH, of some edges by chance.  offset: millimetres."""
        edges, lengths = self.edges
        some = random_rows(edges, EDGES, generator)
        one, other = edges[some].T
        grown = (offset[:, one] - offset[:, other]).square().sum(-1).add(1e-8).sqrt() / lengths[some]
        return (grown - EASY_STRETCH).clamp_min(0.0).square().mean()

    def loss(
        self, corrective: PosedCorrective, contacts: ContactPlanes, generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """The terms of `CorrectiveWeights`, of one batch."""
        w, worn = self.config.weights, contacts.worn
        unbounded = corrective.unbounded(worn.rotations, worn.betas, worn.latents)
        offset = MILLI * unbounded * within_reach(unbounded)[..., None, None]
        size = MILLI**2 * unbounded.square().sum(-1).mean()
        posed, canonical = contacts.distances(offset)
        hinge = (MILLI * w.posed_clearance - posed).clamp_min(0.0).mean()
        of_template = (MILLI * w.canonical_clearance - canonical).clamp_min(0.0).mean()
        rough = apply_laplacian(self.laplacian, offset).abs().mean()
        kept_off = w.hinge * hinge + w.canonical * of_template
        return kept_off + w.size * size + w.laplacian * rough + w.stretch * self.stretch(offset, generator)

    @torch.no_grad()
    def measure(self, corrective: PosedCorrective, worn: WornPoses) -> dict[str, float]:
        """On validation motions: the hinge in posed space before and after, vertices inside, the size of C [mm]."""
        before, after, size = [], [], []
        for part in torch.arange(0, len(worn), 6).split(16):
            some = worn[part]
            X = self.subspace.decode(some.latents)
            offset = corrective(some.rotations, some.betas, some.latents)
            bodies = self.model.body.vertices(some.rotations, some.betas)
            state = self.model.state(some.rotations, some.betas)
            for found, shape in ((before, X), (after, X + offset)):
                found.append((self.distance.between(self.model.posed(shape, state), bodies) < 0).float().mean(1))
            size.append(MILLI * offset.norm(dim=-1).mean(1))
        return {
            "validation inside without, %": 100 * float(torch.cat(before).mean()),
            "validation inside, %": 100 * float(torch.cat(after).mean()),
            "validation size, mm": float(torch.cat(size).mean()),
        }


def _motions_in(folders: Sequence[Path], body: Body) -> list[Motion]:
    return [load_motion(file, body) for folder in folders for file in motion_files(folder)]


def _check_start(start: PosedCorrective, garment_name: str, body: Body, path: Path) -> None:
    found, mine = (start.garment_name, start.joints, start.shapes), (garment_name, len(body.parents), body.shape_count)
    if found != mine:
        raise ValueError(
            f"{path} is a corrective of {found[0]!r} for {found[1]} joints and {found[2]} shape components; "
            f"needed to begin with: {mine[0]!r}, {mine[1]} and {mine[2]}"
        )


def run(config: TrainCorrectiveConfig) -> PosedCorrective:
    """Train (or continue), write `out`/GARMENT-corrective.safetensors with its curves, return it."""
    training = CorrectiveTraining.of(config)
    name = training.data.garment_name
    work = config.out / "work" / f"{name}-corrective"
    corrective = train(training, {split: training.wear(split) for split in ("train", "validation")}, work)
    path = config.out / f"{name}-corrective.safetensors"
    corrective.save(path)
    log.info("written: %s (%.1f MB)", path, path.stat().st_size / 1e6)
    return corrective


def train(training: CorrectiveTraining, worn: Mapping[str, WornPoses], work: Path) -> PosedCorrective:
    """Learn from worn["train"], watch on worn["validation"]; state and curves lie in `work`."""
    config, name = training.config, training.data.garment_name
    for split, poses in worn.items():
        if not len(poses):
            raise ValueError(f"no pose of the {split} motions leaves room for the {name}; take others")
    corrective = training.begin(worn["train"])
    curves: list[ScalarLog] = []
    contacts: list[ContactPlanes] = []  # of the round

    def look(generator: torch.Generator) -> ContactPlanes:
        index = random_rows(worn["train"].rotations, config.round_poses, generator)
        return training.contacts(corrective, worn["train"][index].jittered(config.jitter, generator))

    def loss_of(step: int, generator: torch.Generator) -> Float[Tensor, ""]:
        if step % config.round_steps == 0:
            contacts[:] = [look(generator)]
        index = random_rows(contacts[0].posed, config.batch, generator)
        return training.loss(corrective, contacts[0][index], generator)

    def watch(step: int, loss: float) -> None:
        if not curves:
            curves.append(ScalarLog(work, begin=step + 1))
        if (step + 1) % config.round_steps == 0 or step + 1 == config.fit.steps:
            curves[0].add(step + 1, {"loss": loss, **training.measure(corrective, worn["validation"])})

    fit(
        list(corrective.parameters()),
        loss_of,
        replace(config.fit, checkpoint_every=config.round_steps),  # a run that continues looks anew, and sees the same
        generator=torch.Generator().manual_seed(config.seed + 2),
        checkpoint=work / "checkpoint.safetensors",
        label=f"corrective of {name}",
        watch=watch,
    )
    corrective.eval()
    corrective.story = {
        "config": json.loads(json.dumps(asdict(config), default=str)),
        "start": PosedCorrective.load(config.start).story if config.start else None,
        "curves": read_curves(work / "curves.jsonl"),
    }
    return corrective
