"""4.4, Eq. 13-16: a generative subspace free of collisions.  X (N,3) -> x_bar (25) -> X (N,3).

Deviation from the paper in the 2-core configuration: x_bar is the whitened leading coefficients of the principal
components of the training frames, and the decoder is linear in them but for what a small network adds, which is kept
small (`LossWeights.departure`).  A network that encodes as well, and components that are learned further, brought back
families of motions that they had not seen worse than 25 components alone (README).  Training frames are also seen in a
mirror.  `paper_size()` has the published form (facts.md 1); it was never trained here.
"""

import json
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF, GridSDF
from workbench.collisions.canonical_set import CanonicalSet
from workbench.collisions.mirroring import with_mirrored
from workbench.garments import Garment
from workbench.geometry.laplacian import apply_laplacian, umbrella_laplacian
from workbench.learning.batches import random_rows
from workbench.learning.device import device_named
from workbench.learning.fit import FitConfig, FitResult, fit
from workbench.learning.network_file import read_network, write_network
from workbench.learning.scalar_log import ScalarLog, read_curves

log = logging.getLogger(__name__)

LATENTS = 25  # the paper, Sec. 5
MILLI = 1e3  # losses are in millimetres
LEAST_SPREAD = 3e-3  # metres: vertices and trailing components that move less are not blown up to the others' size
MOST = 4.0  # standard deviations: whitened coefficients are held to that where a network reads them
FORMAT = "subspace-2"
SHIPPED = Path(__file__).parents[1] / "assets" / "models"


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of encoder and decoder: `depth` x [Dense width, ReLU, LayerNorm eps 1e-3] (facts.md 1: 4 x 2000)."""

    width: int = 512  # ours: what two cores train in a quarter of an hour; wider ones were not tried
    depth: int = 4
    rank: int = 256  # principal components in the last layer; 0: dense layers to and from all vertices


@dataclass(frozen=True)
class LossWeights:
    """Eq. 13, terms in millimetres.  The paper leaves all open: ours.  lambda_1 and epsilon were not compared."""

    laplacian: float = 1.0  # lambda_1
    collision: float = 500.0  # lambda_2; of a trial on the dress, 50 left 0.16 % of random garments inside, 300 0.024 %
    kl: float = 0.1  # lambda_3; 0.02 brings held-out families back alike
    departure: float = 0.1  # of the decoder from linearity, on training frames; 0 is the paper's
    random_departure: float = 0.3  # the same on latents drawn from N(0, I)
    self_supervised: bool = True  # the second term of Eq. 16
    clearance: float = 2e-3  # epsilon of Eq. 16, metres


@dataclass(frozen=True)
class TrainSubspaceConfig:
    """`workbench train subspace`: the VAE of one garment from its shipped (or given) training set.

    With --paper, defaults are the published sizes.
    """

    garment: str = "tshirt"
    # A set of canonical garments (.npz, `python -m assets_gen dataset`); the shipped one when absent.
    data: Path | None = None
    out: Path = Path("out/models")
    # Goes into the file name, for variants such as ".plain" (Tab. 1) beside the full model.
    suffix: str = ""
    network: NetworkConfig = NetworkConfig()
    weights: LossWeights = LossWeights()
    batch: int = 32  # training frames a step
    random_batch: int = 32  # latents drawn from N(0, I) a step
    mirrored: bool = True  # each training frame is also seen in a mirror, where garment and body are symmetric
    fit: FitConfig = field(default_factory=lambda: FitConfig(steps=6000, learning_rate=3e-4, checkpoint_every=500))
    watch_every: int = 500  # steps between two points of the curves (Fig. 4)
    seed: int = 0
    device: str = "cpu"  # cpu, cuda, cuda:1, mps; all of a step is computed there

    @staticmethod
    def paper_size() -> "TrainSubspaceConfig":
        """The published form (38.6 million parameters in the decoder of the T-shirt): for a GPU or a night."""
        return TrainSubspaceConfig(
            network=NetworkConfig(width=2000, rank=0),
            batch=128,
            random_batch=128,
            mirrored=False,
            weights=LossWeights(collision=50.0, kl=0.2, departure=0.0, random_departure=0.0),
            fit=FitConfig(steps=50_000),
        )


class Trunk(nn.Module):
    """[Dense, ReLU, LayerNorm] x depth."""

    def __init__(self, inputs: int, config: NetworkConfig, generator: torch.Generator):
        super().__init__()
        layers: list[nn.Module] = []
        for _ in range(config.depth):
            dense = nn.Linear(inputs, config.width)
            nn.init.kaiming_uniform_(dense.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(dense.bias)
            layers += [dense, nn.ReLU(), nn.LayerNorm(config.width, eps=1e-3)]
            inputs = config.width
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Float[Tensor, "*B i"]) -> Float[Tensor, "*B w"]:
        return self.layers(x)


def _head(inputs: int, outputs: int, generator: torch.Generator, gain: float = 1.0) -> nn.Linear:
    head = nn.Linear(inputs, outputs)
    nn.init.normal_(head.weight, std=gain / inputs**0.5, generator=generator)
    nn.init.zeros_(head.bias)
    return head


class Encoder(nn.Module):
    """E: X (N,3) -> mean and log variance of x_bar (25)."""

    middle: Tensor
    view: Tensor

    def __init__(self, statistics: "Statistics", config: NetworkConfig, generator: torch.Generator):
        super().__init__()
        self.register_buffer("middle", statistics.mean.flatten())
        self.register_buffer("view", statistics.view)
        self.trunk = Trunk(statistics.view.shape[-1], config, generator)
        if not config.rank:
            self.mean = _head(config.width, LATENTS, generator)
        self.log_variance = _head(config.width, LATENTS, generator, gain=0.1)

    def forward(self, X: Float[Tensor, "B N 3"]) -> tuple[Float[Tensor, "B L"], Float[Tensor, "B L"]]:
        moved = X.flatten(1) - self.middle
        if self.view.dim() == 1:
            hidden = self.trunk(moved * self.view)
            return self.mean(hidden), self.log_variance(hidden).clamp(-12, 4)
        seen = moved @ self.view
        return seen[:, :LATENTS], self.log_variance(self.trunk(seen.clamp(-MOST, MOST))).clamp(-12, 4)


class Decoder(nn.Module):
    """D: x_bar (25) -> X (N,3): the leading components as x_bar says, and of all what a network adds."""

    basis: Tensor
    middle: Tensor

    def __init__(self, statistics: "Statistics", config: NetworkConfig, generator: torch.Generator):
        super().__init__()
        self.trunk = Trunk(LATENTS, config, generator)
        self.amounts = _head(config.width, len(statistics.basis), generator, gain=0.1)
        # copies: those of `blank` would be filled twice
        self.register_buffer("basis", statistics.basis.clone())  # amounts of about 1 -> metres
        self.register_buffer("middle", statistics.mean.flatten().clone())

    def forward(self, latent: Float[Tensor, "*B L"]) -> Float[Tensor, "*B N 3"]:
        return self.mixed(latent, self.added(latent))

    def added(self, latent: Float[Tensor, "*B L"]) -> Float[Tensor, "*B R"]:
        """Amounts of the components beside what x_bar says."""
        return self.amounts(self.trunk(latent))

    def mixed(self, latent: Float[Tensor, "*B L"], added: Float[Tensor, "*B R"]) -> Float[Tensor, "*B N 3"]:
        """X of both."""
        amounts = added + nn.functional.pad(latent, (0, added.shape[-1] - LATENTS))
        return (self.middle + amounts @ self.basis).unflatten(-1, (-1, 3))

    def departure(self, added: Float[Tensor, "B R"]) -> Float[Tensor, ""]:
        """How far the network moves vertices, root mean square of each garment, millimetres; mean of the garments."""
        size = self.basis.square().sum(1) / (self.basis.shape[1] / 3)  # the components are orthogonal
        return MILLI * ((added.square() * size).sum(-1) + 1e-10).sqrt().mean()


class DenseDecoder(nn.Module):
    """D as published: a dense last layer to all vertices, de-normalised by mean and standard deviation."""

    middle: Tensor
    spread: Tensor

    def __init__(self, statistics: "Statistics", config: NetworkConfig, generator: torch.Generator):
        super().__init__()
        self.trunk = Trunk(LATENTS, config, generator)
        self.last = _head(config.width, statistics.mean.numel(), generator)
        # copies: a file refuses buffers that share memory
        self.register_buffer("middle", statistics.mean.flatten().clone())
        self.register_buffer("spread", statistics.spread.flatten().clone())

    def forward(self, latent: Float[Tensor, "*B L"]) -> Float[Tensor, "*B N 3"]:
        return (self.middle + self.last(self.trunk(latent)) * self.spread).unflatten(-1, (-1, 3))


@dataclass(frozen=True, eq=False)
class Statistics:
    """What the networks know of the training frames before they learn."""

    mean: Float[Tensor, "N 3"]
    spread: Float[Tensor, "N 3"]  # standard deviation, metres
    view: Float[Tensor, "N3 I"] | Float[Tensor, "N3"]  # X - mean -> the encoder's input: a matrix, or a factor each
    basis: Float[Tensor, "R N3"]  # amounts of about 1 -> metres

    @staticmethod
    def of(data: CanonicalSet, config: NetworkConfig) -> "Statistics":
        amounts = data.kept("train")
        basis = data.flat_basis
        spread = ((amounts - amounts.mean(0)).square().mean(0)[:, None] * basis.square()).sum(0).sqrt()
        spread = spread.unflatten(0, (-1, 3)).clamp_min(LEAST_SPREAD)
        if not config.rank:
            return Statistics(data.mean, spread, 1 / spread.flatten(), basis[:0])
        basis = basis[: config.rank]
        size = amounts[:, : config.rank].std(0)
        size = size + LEAST_SPREAD * (torch.arange(len(size)) >= LATENTS)  # x_bar has a variance of 1
        view = basis.T / len(data.mean) / size
        return Statistics(data.mean, spread, view, basis * size[:, None])

    @staticmethod
    def blank(vertices: int, config: NetworkConfig) -> "Statistics":
        """Of the right shapes, to be filled from a file."""
        flat = 3 * vertices
        zero = torch.zeros(vertices, 3)
        view = torch.zeros(flat, config.rank) if config.rank else torch.ones(flat)
        return Statistics(zero, zero, view, torch.zeros(config.rank, flat))


class Subspace(nn.Module):
    """The VAE of one garment: `encode`, `decode`, `sample`; made for one topology."""

    def __init__(
        self, garment_name: str, statistics: Statistics, config: NetworkConfig, generator: torch.Generator | None = None
    ):
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        self.garment_name, self.config = garment_name, config
        self.own_garment: Garment | None = None  # where it is none of those that ship
        self.encoder = Encoder(statistics, config, generator)
        self.decoder: Decoder | DenseDecoder = (Decoder if config.rank else DenseDecoder)(statistics, config, generator)
        self.story: dict = {}  # what made it: configuration, curves, scores

    @property
    def vertex_count(self) -> int:
        return self.decoder.middle.numel() // 3

    @property
    def garment(self) -> Garment:
        """Template and topology.  Raises ValueError when the garment has another vertex count."""
        garment = self.own_garment or Garment.load(self.garment_name)
        if len(garment.vertices) != self.vertex_count:
            raise ValueError(
                f"garment {garment.name!r} has {len(garment.vertices)} vertices, but its subspace "
                f"{self.vertex_count}; train it again with `workbench train subspace`"
            )
        return garment

    def encode(self, X: Float[Tensor, "B N 3"]) -> Float[Tensor, "B L"]:
        """x_bar of canonical garments: the mean of E(X)."""
        if X.shape[-2] != self.vertex_count:
            raise ValueError(
                f"the garment has {X.shape[-2]} vertices, but the subspace of {self.garment_name!r} {self.vertex_count}"
            )
        return self.encoder(X)[0]

    def decode(self, latent: Float[Tensor, "*B L"]) -> Float[Tensor, "*B N 3"]:
        """X = D(x_bar), metres, canonical space."""
        if latent.shape[-1] != LATENTS:
            raise ValueError(f"a latent has {LATENTS} numbers, got {latent.shape[-1]}")
        return self.decoder(latent)

    def decode_watched(self, latent: Float[Tensor, "*B L"]) -> tuple[Float[Tensor, "*B N 3"], Float[Tensor, ""]]:
        """X, and how far D departs from linearity (`Decoder.departure`; 0 for the published form)."""
        if isinstance(self.decoder, DenseDecoder):
            return self.decoder(latent), latent.new_zeros(())
        added = self.decoder.added(latent)
        return self.decoder.mixed(latent, added), self.decoder.departure(added)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "B N 3"]:
        """Garments decoded from N(0, I)."""
        return self.decode(torch.randn(count, LATENTS, generator=generator).to(self.decoder.middle.device))

    def save(self, path: Path) -> None:
        """The parameters, with what made them."""
        metadata = {
            "format": FORMAT,
            "garment": self.garment_name,
            "vertices": str(self.vertex_count),
            "network": json.dumps(asdict(self.config)),
            "story": json.dumps(self.story),
        }
        beside = self.own_garment.tensors() if self.own_garment is not None else {}
        write_network(self, path, metadata, coarse={"encoder.view": 0, "decoder.basis": LATENTS}, beside=beside)

    @staticmethod
    def load(path: str | Path) -> "Subspace":
        """Read what `save` wrote.  Raises FileNotFoundError, or ValueError for a damaged or foreign file."""
        found = read_network(Path(path), "train it with `workbench train subspace`")
        metadata = found.metadata
        if metadata.get("format") != FORMAT:
            raise ValueError(
                f"{path} is no subspace (format {metadata.get('format')!r}, expected {FORMAT!r}); "
                "train it with `workbench train subspace`"
            )
        config = NetworkConfig(**json.loads(metadata["network"]))
        blank = Statistics.blank(int(metadata["vertices"]), config)
        subspace = Subspace(metadata["garment"], blank, config)
        subspace.own_garment = Garment.from_tensors(subspace.garment_name, found.tensors)
        subspace.load_state_dict({key: t for key, t in found.tensors.items() if not key.startswith("garment.")})
        subspace.story = json.loads(metadata["story"])
        return subspace.eval()

    @staticmethod
    def shipped(garment_name: str) -> "Subspace":
        """The subspace that ships for a garment.  Raises ValueError naming those there are."""
        path = SHIPPED / f"{garment_name}-subspace.safetensors"
        if not path.is_file():
            known = ", ".join(sorted(p.name.rpartition("-")[0] for p in SHIPPED.glob("*-subspace.safetensors")))
            raise ValueError(f"no subspace of garment {garment_name!r} ships; there are: {known or 'none'}")
        return Subspace.load(path)


# The four terms of Eq. 13, in millimetres


def reconstruction_loss(X: Float[Tensor, "B N 3"], decoded: Float[Tensor, "B N 3"]) -> Float[Tensor, ""]:
    """| X - D(E(X)) |_1      (Eq. 14), a number"""
    return MILLI * (X - decoded).abs().mean()


def laplacian_loss(
    X: Float[Tensor, "B N 3"], decoded: Float[Tensor, "B N 3"], laplacian: Float[Tensor, "N N"]
) -> Float[Tensor, ""]:
    """| Delta X - Delta D(E(X)) |_1      (Eq. 15)"""
    return MILLI * apply_laplacian(laplacian, X - decoded).abs().mean()


def collision_loss(sdf: BodySDF, decoded: Float[Tensor, "B N 3"], clearance: float) -> Float[Tensor, ""]:
    """max(epsilon - SDF(X), 0), mean over the vertices      (one term of Eq. 16)

    Only vertices that are too near have a gradient: the others are looked up without one.
    """
    with torch.no_grad():
        near = sdf(decoded.detach()) < clearance
    return MILLI * (clearance - sdf(decoded[near])).clamp_min(0.0).sum() / near.numel()


def kl_loss(mean: Float[Tensor, "B L"], log_variance: Float[Tensor, "B L"]) -> Float[Tensor, ""]:
    """KL(N(mean, variance) || N(0, I)), mean over the batch."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1).mean()


@dataclass(frozen=True, eq=False)
class SubspaceLoss:
    """L_VAE of one step."""

    sdf: BodySDF
    laplacian: Float[Tensor, "N N"]
    weights: LossWeights

    def __call__(
        self,
        subspace: Subspace,
        X: Float[Tensor, "B N 3"],
        generator: torch.Generator,
        random_batch: int,
    ) -> Float[Tensor, ""]:
        w = self.weights
        mean, log_variance = subspace.encoder(X)
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        decoded, departed = subspace.decode_watched(mean + (0.5 * log_variance).exp() * noise)
        rec = reconstruction_loss(X, decoded) + w.departure * departed
        lap = laplacian_loss(X, decoded, self.laplacian)
        kl = kl_loss(mean, log_variance)
        col = collision_loss(self.sdf, decoded, w.clearance)
        if w.self_supervised:
            chance = torch.randn(random_batch, LATENTS, generator=generator).to(mean.device)
            imagined, departed = subspace.decode_watched(chance)
            col = col + collision_loss(self.sdf, imagined, w.clearance)  # Eq. 16
            rec = rec + w.random_departure * departed
        return rec + w.laplacian * lap + w.collision * col + w.kl * kl  # Eq. 13


@dataclass(frozen=True, eq=False)
class SubspaceTraining:
    """One run: data, networks, loss; `run(config)` does it all."""

    config: TrainSubspaceConfig
    data: CanonicalSet
    subspace: Subspace
    loss: SubspaceLoss

    @staticmethod
    def of(config: TrainSubspaceConfig) -> "SubspaceTraining":
        """What does not depend on the device is made on the CPU, alike for all, then moved."""
        device = device_named(config.device)
        data = CanonicalSet.load(config.data) if config.data else CanonicalSet.shipped(config.garment)
        data = with_mirrored(data, Body.default()) if config.mirrored else data
        network = replace(config.network, rank=min(config.network.rank, data.rank))
        generator = torch.Generator().manual_seed(config.seed)
        subspace = Subspace(data.garment_name, Statistics.of(data, network), network, generator)
        subspace.own_garment = data.own_garment
        laplacian = umbrella_laplacian(data.garment.faces, len(data.mean)).to(device)
        loss = SubspaceLoss(GridSDF.default().to(device), laplacian, config.weights)
        return SubspaceTraining(config, data.to(device), subspace.to(device), loss)

    @cached_property
    def frames(self) -> Float[Tensor, "M R"]:
        return self.data.kept("train")

    def step(self, _: int, generator: torch.Generator) -> Float[Tensor, ""]:
        index = random_rows(self.frames, self.config.batch, generator)
        return self.loss(self.subspace, self.data.garments(self.frames[index]), generator, self.config.random_batch)


def run(config: TrainSubspaceConfig) -> Subspace:
    """Train (or continue), write `out`/GARMENT-subspace.safetensors with its curves, return it, on the CPU.

    Raises ValueError for a device that is not there.
    """
    training = SubspaceTraining.of(config)
    name = f"{training.data.garment_name}{config.suffix}"
    work = config.out / "work" / f"{name}-subspace"
    train(training, work)
    subspace = training.subspace.cpu().eval()
    subspace.story = {
        "config": _plain(config),
        "curves": read_curves(work / "curves.jsonl"),
    }
    path = config.out / f"{name}-subspace.safetensors"
    subspace.save(path)
    log.info("written: %s (%.1f MB)", path, path.stat().st_size / 1e6)
    return subspace


def train(training: SubspaceTraining, work: Path) -> FitResult:
    """The optimisation, with a point of the curves every `watch_every` steps."""
    config, checkpoint = training.config, work / "checkpoint.safetensors"
    curves: list[ScalarLog] = []

    def watch(step: int, loss: float) -> None:
        if not curves:
            curves.append(ScalarLog(work, begin=step + 1))
        if (step + 1) % config.watch_every == 0 or step + 1 == config.fit.steps:
            curves[0].add(step + 1, {"loss": loss, **measure(training)})

    return fit(
        list(training.subspace.parameters()),
        training.step,
        config.fit,
        generator=torch.Generator().manual_seed(config.seed + 1),
        checkpoint=checkpoint,
        label=f"subspace of {training.data.garment_name}",
        watch=watch,
    )


@torch.no_grad()
def measure(training: SubspaceTraining, frames: int = 256, samples: int = 256) -> dict[str, float]:
    """On sequences that the training does not see: reconstruction error [mm], collisions [% of vertices]; the same
    collisions for garments drawn from N(0, I)."""
    generator = torch.Generator().manual_seed(17)
    unseen = training.data.kept("validation")
    chosen = torch.randperm(len(unseen), generator=generator)[:frames].to(unseen.device)
    X = training.data.garments(unseen[chosen])
    decoded = training.subspace.decode(training.subspace.encode(X))
    imagined = training.subspace.sample(samples, generator)
    return {
        "validation error, mm": float(MILLI * (decoded - X).norm(dim=-1).mean()),
        "validation inside, %": share_inside(training.loss.sdf, decoded),
        "samples inside, %": share_inside(training.loss.sdf, imagined),
    }


def share_inside(sdf: Callable[[Tensor], Tensor], X: Float[Tensor, "B N 3"]) -> float:
    """Vertices inside the canonical body, percent."""
    return 100 * float((sdf(X) < 0).float().mean())


def _plain(config: TrainSubspaceConfig) -> dict:
    return json.loads(json.dumps(asdict(config), default=str))
