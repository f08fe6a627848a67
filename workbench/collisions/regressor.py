"""5, Eq. 1 and 18: the regressor.  beta (10), gamma (T,42) -> x_bar (T,25), X = D(x_bar).

GRU 2 x 500, then a dense layer (facts.md 1).  The pose descriptor is first fitted so that what a pose does to the
garment's template can be read off its 10 numbers, then trained together with the regressor.

Beyond the paper, since a few dozen motions are soon learned by heart: each is also seen in a mirror, inputs are noisy
and hidden units are left out in training; and latents count by how far they move the garment (README has what it is
worth).
"""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from workbench.body.model import Body
from workbench.collisions.canonical_set import CanonicalSequence, CanonicalSet
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.mirroring import with_mirrored
from workbench.collisions.motion_descriptor import (
    DESCRIPTOR_SIZE,
    POSE_SIZE,
    PoseDescriptor,
    descriptor,
    global_motion,
)
from workbench.collisions.subspace import LATENTS, SHIPPED, Subspace
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning.batches import random_rows
from workbench.learning.device import device_named
from workbench.learning.fit import FitConfig, FitResult, fit
from workbench.learning.network_file import read_network, write_network
from workbench.learning.scalar_log import ScalarLog, read_curves

log = logging.getLogger(__name__)

HIDDEN, LAYERS = 500, 2  # facts.md 1
FARTHEST_INPUT = 5  # standard deviations: inputs are clipped there
FORMAT = "regressor-1"


@dataclass(frozen=True)
class RegressorWeights:
    """Eq. 18.  The paper leaves rho_1 and rho_2 open: ours, not tuned."""

    velocity: float = 1.0  # rho_1, a frame
    acceleration: float = 0.5  # rho_2, a frame squared


@dataclass(frozen=True)
class TrainRegressorConfig:
    """`workbench train regressor`: from a trained subspace and the training set it was made of.

    The network has the published size; more steps are all that a larger machine would add.
    """

    garment: str = "tshirt"
    # A set of canonical garments (.npz); the shipped one when absent.
    data: Path | None = None
    # The folder with GARMENT-subspace.safetensors, also written to.
    out: Path = Path("out/models")
    # Goes into the file names of subspace and regressor, for variants such as ".plain" (Tab. 1) beside the full model.
    suffix: str = ""
    weights: RegressorWeights = RegressorWeights()
    window: int = 40  # frames
    batch: int = 16  # windows a step
    describe: FitConfig = field(default_factory=lambda: FitConfig(steps=1500, learning_rate=2e-3))
    fit: FitConfig = field(default_factory=lambda: FitConfig(steps=2000, learning_rate=1e-3))
    mirrored: bool = True  # each training motion is also seen in a mirror, where garment and body are symmetric
    describe_jitter: float = 0.15  # radians, standard deviation of each joint's turn, where the descriptor is fitted
    noise: float = 0.2  # standard deviations of the inputs, added to each in training
    dropout: float = 0.3  # share of hidden units that are left out in training, after either layer
    watch_every: int = 500
    seed: int = 0
    device: str = "cpu"  # cpu, cuda, cuda:1, mps; all of a step is computed there


class Regressor(nn.Module):
    """x_bar = R(beta, gamma): GRU (2 x 500) and a dense layer; inputs standardised."""

    centre: Tensor
    size: Tensor

    def __init__(
        self, garment_name: str, joints: int, shapes: int, fps: float, generator: torch.Generator | None = None
    ):
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        self.garment_name, self.joints, self.shapes, self.fps = garment_name, joints, shapes, fps
        self.describe = PoseDescriptor(joints, generator)
        inputs = DESCRIPTOR_SIZE + shapes
        self.register_buffer("centre", torch.zeros(inputs))
        self.register_buffer("size", torch.ones(inputs))
        self.gru = nn.GRU(inputs, HIDDEN, num_layers=LAYERS, batch_first=True)
        self.last = nn.Linear(HIDDEN, LATENTS)
        for parameter in (*self.gru.parameters(), *self.last.parameters()):
            nn.init.uniform_(parameter, -(HIDDEN**-0.5), HIDDEN**-0.5, generator=generator)
        self.story: dict = {}

    def inputs(
        self, rotations: Float[Tensor, "B T J 3 3"], translation: Float[Tensor, "B T 3"], betas: Float[Tensor, "B K"]
    ) -> Float[Tensor, "B T I"]:
        """gamma and beta of every frame, standardised; clipped at FARTHEST_INPUT."""
        moving = global_motion(rotations[..., 0, :, :], translation, self.fps).stacked()
        gamma = descriptor(self.describe(rotations), moving, self.fps)
        together = torch.cat([gamma, betas[:, None].expand(*gamma.shape[:2], -1)], dim=-1)
        return ((together - self.centre) / self.size).clamp(-FARTHEST_INPUT, FARTHEST_INPUT)

    def forward(
        self, rotations: Float[Tensor, "B T J 3 3"], translation: Float[Tensor, "B T 3"], betas: Float[Tensor, "B K"]
    ) -> Float[Tensor, "B T L"]:
        """The latents of whole motions, from rest (the recurrent state starts at zero)."""
        hidden, _ = self.gru(self.inputs(rotations, translation, betas))
        return self.last(hidden)

    def disturbed(
        self,
        rotations: Float[Tensor, "B T J 3 3"],
        translation: Float[Tensor, "B T 3"],
        betas: Float[Tensor, "B K"],
        noise: float,
        dropout: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "B T L"]:
        """The same with noisy inputs and without a share of the hidden units of each frame: what training sees."""
        inputs = self.inputs(rotations, translation, betas)
        inputs = inputs + noise * torch.randn(inputs.shape, generator=generator).to(inputs.device)
        with torch.random.fork_rng():
            seed = int(torch.randint(2**62, (), generator=generator))
            torch.manual_seed(seed)  # noqa: TID251  dropout takes no generator
            self.gru.dropout = dropout
            hidden, _ = self.gru(inputs)
            hidden = nn.functional.dropout(hidden, dropout, self.training)
            self.gru.dropout = 0.0
        return self.last(hidden)

    @torch.no_grad()
    def standardise(self, sequences: Sequence[CanonicalSequence]) -> None:
        """Set the inputs' mean and size from training sequences."""
        rows = []
        for s in sequences:
            moving = global_motion(s.rotations[:, 0], s.translation, self.fps).stacked()
            gamma = descriptor(self.describe(s.rotations), moving, self.fps)
            rows.append(torch.cat([gamma, s.betas.expand(len(gamma), -1)], dim=-1))
        every = torch.cat(rows)
        self.centre.copy_(every.mean(0))
        self.size.copy_(every.std(0).clamp_min(1e-3))
        self.centre[-self.shapes :] = 0
        self.size[-self.shapes :] = 1

    def save(self, path: Path) -> None:
        """The parameters, with what made them."""
        metadata = {
            "format": FORMAT,
            "garment": self.garment_name,
            "joints": str(self.joints),
            "shapes": str(self.shapes),
            "fps": str(self.fps),
            "story": json.dumps(self.story),
        }
        recurrent = [name for name in self.state_dict() if name.startswith("gru.weight_hh")]
        write_network(self, path, metadata, coarse=dict.fromkeys([*recurrent, "gru.weight_ih_l1"], 0))

    @staticmethod
    def load(path: str | Path) -> "Regressor":
        """Read what `save` wrote.  Raises FileNotFoundError, or ValueError for a damaged or foreign file."""
        found = read_network(Path(path), "train it with `workbench train regressor`")
        metadata = found.metadata
        if metadata.get("format") != FORMAT:
            raise ValueError(f"{path} is no regressor (format {metadata.get('format')!r}, expected {FORMAT!r})")
        sizes = (int(metadata["joints"]), int(metadata["shapes"]), float(metadata["fps"]))
        regressor = Regressor(metadata["garment"], *sizes)
        regressor.load_state_dict(found.tensors)
        regressor.story = json.loads(metadata["story"])
        return regressor.eval()

    @staticmethod
    def shipped(garment_name: str) -> "Regressor":
        """The regressor that ships for a garment.  Raises ValueError naming those there are."""
        path = SHIPPED / f"{garment_name}-regressor.safetensors"
        if not path.is_file():
            known = ", ".join(sorted(p.name.rpartition("-")[0] for p in SHIPPED.glob("*-regressor.safetensors")))
            raise ValueError(f"no regressor of garment {garment_name!r} ships; there are: {known or 'none'}")
        return Regressor.load(path)


# The three terms of Eq. 18, on frames that the simulation kept; latents may be scaled by what they count


def position_loss(found: Float[Tensor, "B T L"], wanted: Float[Tensor, "B T L"], kept: Bool[Tensor, "B T"]) -> Tensor:
    """L_pos of Eq. 18: L1 of the latents."""
    return _masked(found - wanted, kept)


def velocity_loss(found: Float[Tensor, "B T L"], wanted: Float[Tensor, "B T L"], kept: Bool[Tensor, "B T"]) -> Tensor:
    """L_vel of Eq. 18, a frame."""
    return _masked((found - wanted).diff(dim=1), kept[:, 1:] & kept[:, :-1])


def acceleration_loss(
    found: Float[Tensor, "B T L"], wanted: Float[Tensor, "B T L"], kept: Bool[Tensor, "B T"]
) -> Tensor:
    """L_acc of Eq. 18, a frame squared."""
    return _masked((found - wanted).diff(n=2, dim=1), kept[:, 2:] & kept[:, 1:-1] & kept[:, :-2])


def _masked(difference: Float[Tensor, "B T L"], kept: Bool[Tensor, "B T"]) -> Float[Tensor, ""]:
    return (difference.abs().mean(-1) * kept).sum() / kept.sum().clamp_min(1)


@dataclass(frozen=True, eq=False)
class Windows:
    """Pieces of motions, side by side."""

    rotations: Float[Tensor, "B T J 3 3"]
    translation: Float[Tensor, "B T 3"]
    betas: Float[Tensor, "B K"]
    latents: Float[Tensor, "B T L"]
    kept: Bool[Tensor, "B T"]


@dataclass(frozen=True, eq=False)
class RegressorTraining:
    """One run: data with its latents, the regressor."""

    config: TrainRegressorConfig
    body: Body
    data: CanonicalSet
    subspace: Subspace
    latents: dict[str, list[Float[Tensor, "T L"]]]  # of every sequence of a split
    regressor: Regressor

    @staticmethod
    def of(config: TrainRegressorConfig) -> "RegressorTraining":
        device = device_named(config.device)
        data = CanonicalSet.load(config.data) if config.data else CanonicalSet.shipped(config.garment)
        data = (with_mirrored(data, Body.default()) if config.mirrored else data).to(device)
        subspace = Subspace.load(config.out / f"{data.garment_name}{config.suffix}-subspace.safetensors").to(device)
        for parameter in subspace.parameters():
            parameter.requires_grad_(False)
        body = Body.default()
        with torch.no_grad():
            latents = {
                split: [subspace.encode(data.garments(s.coefficients)) for s in data.of_split(split)]
                for split in ("train", "validation")
            }
        regressor = Regressor(
            data.garment_name,
            len(body.parents),
            body.shape_count,
            data.fps,
            torch.Generator().manual_seed(config.seed),
        )
        return RegressorTraining(config, body.to(device), data, subspace, latents, regressor.to(device))

    @cached_property
    def counts(self) -> Float[Tensor, " L"]:
        """What each latent counts: how far one unit of it moves the garment's vertices, root mean square over garments
        drawn from N(0, I); 1 on average."""
        latent = torch.randn(32, LATENTS, generator=torch.Generator().manual_seed(11)).to(self.data.mean.device)
        moved = [
            (self.subspace.decode(latent + step) - self.subspace.decode(latent - step)).square().mean().sqrt()
            for step in 0.5 * torch.eye(LATENTS, device=latent.device)
        ]
        return torch.stack(moved) / torch.stack(moved).mean()

    def windows(self, split: str, count: int, length: int, generator: torch.Generator) -> Windows:
        """`count` random windows of `length` frames (shorter sequences are repeated at their end, not kept there)."""
        sequences, latents = self.data.of_split(split), self.latents[split]
        which = torch.randint(len(sequences), (count,), generator=generator).tolist()
        parts = []
        for i in which:
            s = sequences[i]
            begin = int(torch.randint(max(1, len(s) - length + 1), (1,), generator=generator))
            frame = begin + torch.arange(length, device=s.valid.device)
            index = frame.clamp(max=len(s) - 1)
            kept = s.valid[index] & (frame < len(s))
            parts.append((s.rotations[index], s.translation[index], s.betas, latents[i][index], kept))
        return Windows(*(torch.stack(column) for column in zip(*parts, strict=True)))

    def step(self, _: int, generator: torch.Generator) -> Float[Tensor, ""]:
        """L_R of Eq. 18, on random windows."""
        w, batch = self.config.weights, self.windows("train", self.config.batch, self.config.window, generator)
        chance = (self.config.noise, self.config.dropout, generator)
        found = self.regressor.disturbed(batch.rotations, batch.translation, batch.betas, *chance)
        given = (found * self.counts, batch.latents * self.counts, batch.kept)
        return position_loss(*given) + w.velocity * velocity_loss(*given) + w.acceleration * acceleration_loss(*given)


def fit_descriptor(training: RegressorTraining, work: Path) -> FitResult:
    """theta_bar first: a small network has to read off it where the pose brings the template and the joints."""
    config, body = training.config, training.body
    device = body.template.device
    generator = torch.Generator().manual_seed(config.seed + 3)
    template = training.data.garment.vertices
    chosen = template[torch.randperm(len(template), generator=generator)[:200]]
    weights, chosen = GridFields.default().at(chosen).weights.to(device), chosen.to(device)
    rotations = torch.cat([s.rotations for s in training.data.of_split("train")])
    reader = nn.Sequential(nn.Linear(POSE_SIZE, 256), nn.ReLU(), nn.Linear(256, 3 * (len(chosen) + len(body.parents))))
    for layer in (reader[0], reader[2]):
        assert isinstance(layer, nn.Linear)
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
        nn.init.zeros_(layer.bias)
    reader.to(device)

    def loss_of(_: int, chance: torch.Generator) -> Float[Tensor, ""]:
        index = random_rows(rotations, 64, chance)
        with torch.no_grad():
            turns = config.describe_jitter * torch.randn(len(index), *rotations.shape[1:3], generator=chance)
            seen = rotations[index] @ axis_angle_to_matrix(turns.to(device))
            local = seen.clone()
            local[:, 0] = torch.eye(3, device=device)  # what the root does is not the pose's
            posed = body.pose(local, body.mean_shape())
            blended = torch.einsum("nj,bjik->bnik", weights, posed.transforms.rotation)
            shift = torch.einsum("nj,bji->bni", weights, posed.transforms.translation)
            points = torch.einsum("bnik,nk->bni", blended, chosen) + shift
            wanted = torch.cat([points, posed.joints], dim=1)
        read = reader(training.regressor.describe(seen)).unflatten(-1, (-1, 3))
        return (read - wanted).norm(dim=-1).mean()

    parameters = [*training.regressor.describe.parameters(), *reader.parameters()]
    return fit(
        parameters,
        loss_of,
        config.describe,
        generator=torch.Generator().manual_seed(config.seed + 4),
        checkpoint=work / "descriptor.safetensors",
        label="pose descriptor",
    )


def run(config: TrainRegressorConfig) -> Regressor:
    """Train (or continue), write `out`/GARMENT-regressor.safetensors with its curves, return it, on the CPU.

    Raises ValueError for a device that is not there.
    """
    training = RegressorTraining.of(config)
    name = f"{training.data.garment_name}{config.suffix}"
    work = config.out / "work" / f"{name}-regressor"
    regressor = training.regressor
    fit_descriptor(training, work)
    regressor.standardise(training.data.of_split("train"))
    train(training, work)
    regressor.cpu().eval()
    regressor.story = {
        "config": json.loads(json.dumps(asdict(config), default=str)),
        "curves": read_curves(work / "curves.jsonl"),
    }
    path = config.out / f"{name}-regressor.safetensors"
    regressor.save(path)
    log.info("written: %s (%.1f MB)", path, path.stat().st_size / 1e6)
    return regressor


def train(training: RegressorTraining, work: Path) -> FitResult:
    """Eq. 18, with a point of the curves every `watch_every` steps."""
    config = training.config
    curves: list[ScalarLog] = []

    def watch(step: int, loss: float) -> None:
        if not curves:
            curves.append(ScalarLog(work, begin=step + 1))
        if (step + 1) % config.watch_every == 0 or step + 1 == config.fit.steps:
            curves[0].add(step + 1, {"loss": loss, **measure(training)})

    return fit(
        list(training.regressor.parameters()),
        training.step,
        config.fit,
        generator=torch.Generator().manual_seed(config.seed + 1),
        checkpoint=work / "checkpoint.safetensors",
        label=f"regressor of {training.data.garment_name}",
        watch=watch,
    )


@torch.no_grad()
def measure(training: RegressorTraining) -> dict[str, float]:
    """On sequences that the training does not see: error of the latents and of X [mm]."""
    latent_error, error, frames = 0.0, 0.0, 0
    for s, wanted in zip(training.data.of_split("validation"), training.latents["validation"], strict=True):
        found = training.regressor(s.rotations[None], s.translation[None], s.betas[None])[0]
        pick = torch.arange(0, len(s), 12, device=s.valid.device)
        pick = pick[s.valid[pick]]
        if not len(pick):
            continue
        X = training.subspace.decode(found[pick])
        truth = training.data.garments(s.coefficients[pick])
        latent_error += float((found[pick] - wanted[pick]).abs().mean()) * len(pick)
        error += 1e3 * float((X - truth).norm(dim=-1).mean()) * len(pick)
        frames += len(pick)
    return {
        "validation latent error": latent_error / frames,
        "validation error, mm": error / frames,
    }
