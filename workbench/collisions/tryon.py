"""5-6: the runtime.  beta (10), motion -> x_bar (T,25) -> X (T,N,3) -> posed garment (T,N,3).

X = D(x_bar), and where a corrective is trained X = D(x_bar) + C(theta, beta, x_bar) (`posed_corrective`).

`TryOn.run` dresses a whole motion; `TryOn.stream` a frame at a time, with the same result.  The networks run in torch,
or in onnxruntime (`tryon_onnx`); the fields come from the table or the paper's networks (`GarmentModel.fields`).
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.frame_posing import frame_poser
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.motion_descriptor import DescriptorStream
from workbench.collisions.posed_corrective import PosedCorrective
from workbench.collisions.regressor import FARTHEST_INPUT, HIDDEN, LAYERS, Regressor
from workbench.collisions.subspace import SHIPPED, Subspace
from workbench.formats import load_motion
from workbench.garments import Garment
from workbench.motion import Motion
from workbench.motion_doubts import mended
from workbench.store import atomic_write

log = logging.getLogger(__name__)

FARTHEST_SHAPE = 5.0  # standard deviations: beyond it the linear body is no body any more
POSED_AT_ONCE = 32  # frames: bounds the memory


@dataclass(frozen=True, eq=False)
class TryOnResult:
    """A dressed motion, every stage of it."""

    latent: Float[Tensor, "T L"]
    canonical: Float[Tensor, "T N 3"]
    garment: Float[Tensor, "T N 3"]
    body: Float[Tensor, "T V 3"]
    garment_faces: Tensor
    body_faces: Tensor
    betas: Float[Tensor, "K"]
    motion: Motion

    def save(self, path: str | Path) -> None:
        """npz as the command contract names its arrays; written whole or not at all."""
        arrays = {
            "body_vertices": self.body.numpy(),
            "body_faces": self.body_faces.numpy().astype(np.int32),
            "garment_vertices": self.garment.numpy(),
            "garment_faces": self.garment_faces.numpy().astype(np.int32),
            "canonical": self.canonical.numpy(),
            "latent": self.latent.numpy(),
            "betas": self.betas.numpy(),
            "fps": np.array(self.motion.fps),
        }
        with atomic_write(path) as part:
            np.savez(part, **arrays)


class Networks(ABC):
    """One step of the regressor and the decoder: all that a stream needs of a runtime."""

    @abstractmethod
    def regress(
        self, inputs: Float[Tensor, "I"], hidden: Float[Tensor, "Y 1 H"]
    ) -> tuple[Float[Tensor, "L"], Float[Tensor, "Y 1 H"]]: ...

    @abstractmethod
    def decode(self, latent: Float[Tensor, "L"]) -> Float[Tensor, "N 3"]: ...


@dataclass(frozen=True, eq=False)
class TorchNetworks(Networks):
    """The networks as they were trained."""

    regressor: Regressor
    subspace: Subspace

    def regress(
        self, inputs: Float[Tensor, "I"], hidden: Float[Tensor, "Y 1 H"]
    ) -> tuple[Float[Tensor, "L"], Float[Tensor, "Y 1 H"]]:
        out, hidden = self.regressor.gru(inputs[None, None], hidden)
        return self.regressor.last(out)[0, 0], hidden

    def decode(self, latent: Float[Tensor, "L"]) -> Float[Tensor, "N 3"]:
        return self.subspace.decode(latent)


# theta, beta, x_bar -> an offset of X: a PosedCorrective, or the same in another runtime
Corrective = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class TryOn:
    """Dresses a body in one garment."""

    model: GarmentModel
    regressor: Regressor
    subspace: Subspace
    garment: Garment
    networks: Networks
    corrective: Corrective | None = None  # beyond the paper

    @staticmethod
    def shipped(garment_name: str) -> "TryOn":
        """With the networks that ship for a garment, on the default body."""
        return TryOn.of(
            Subspace.shipped(garment_name),
            Regressor.shipped(garment_name),
            corrective=PosedCorrective.beside(SHIPPED, garment_name),
        )

    @staticmethod
    def of(
        subspace: Subspace,
        regressor: Regressor,
        model: GarmentModel | None = None,
        corrective: PosedCorrective | None = None,
    ) -> "TryOn":
        """Raises ValueError when the networks belong to different garments, or the garment or body to neither."""
        model = model or GarmentModel(Body.default(), GridFields.default())
        if subspace.garment_name != regressor.garment_name:
            raise ValueError(
                f"the subspace is of garment {subspace.garment_name!r}, but the regressor of "
                f"{regressor.garment_name!r}; load a pair that was trained together"
            )
        garment = subspace.garment
        joints = len(model.body.parents)
        if joints != regressor.joints:
            raise ValueError(f"the body has {joints} joints, but the regressor was trained for {regressor.joints}")
        if corrective is not None:
            _check_fit(corrective, subspace, regressor)
        return TryOn(model, regressor, subspace, garment, TorchNetworks(regressor, subspace), corrective)

    def stream(self, betas: Float[Tensor, "K"]) -> "TryOnStream":
        """Frame by frame, for one shape."""
        return TryOnStream(self, checked_shape(betas, self.model.body))

    @torch.no_grad()
    def latents(self, motion: Motion, betas: Float[Tensor, "K"]) -> Float[Tensor, "T L"]:
        """x_bar of every frame      (Eq. 1)"""
        motion = self._at_rate(motion)
        return self.regressor(motion.rotations[None], motion.translation[None], betas[None])[0]

    def shaped(
        self, latent: Float[Tensor, "*B L"], rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "K"]
    ) -> Float[Tensor, "*B N 3"]:
        """X of latents in poses: decoded, and corrected where there is a corrective."""
        X = self.subspace.decode(latent)
        if self.corrective is None:
            return X
        return X + self.corrective(rotations, betas.expand(*latent.shape[:-1], -1), latent)

    @torch.no_grad()
    def canonical(self, motion: Motion, betas: Float[Tensor, "K"], every: int = 1) -> Float[Tensor, "T N 3"]:
        """X of one frame in `every` of a motion; the regressor sees all of them."""
        motion = self._at_rate(motion)
        return self.shaped(self.latents(motion, betas)[::every], motion.rotations[::every], betas)

    @torch.no_grad()
    def run(
        self, motion: Motion, betas: Float[Tensor, "K"], progress: Callable[[int], None] = lambda frames: None
    ) -> TryOnResult:
        """A whole motion, resampled to the networks' frame rate.

        Errors: ValueError for a shape of the wrong length, of NaN or beyond FARTHEST_SHAPE, or another skeleton.
        """
        betas = checked_shape(betas, self.model.body)
        motion = self._at_rate(motion)
        latent = self.latents(motion, betas)
        frames, vertices, body = len(motion), self.subspace.vertex_count, self.model.body
        canonical, garment = latent.new_empty(frames, vertices, 3), latent.new_empty(frames, vertices, 3)
        bodies = latent.new_empty(frames, len(body.template), 3)
        for part in (slice(at, at + POSED_AT_ONCE) for at in range(0, frames, POSED_AT_ONCE)):
            rotations, translation = motion.rotations[part], motion.translation[part]
            canonical[part] = self.shaped(latent[part], rotations, betas)
            state = self.model.state(rotations, betas, translation)
            garment[part] = self.model.posed(canonical[part], state)
            bodies[part] = body.vertices(rotations, betas, translation)
            progress(len(rotations))
        return TryOnResult(
            latent=latent,
            canonical=canonical,
            garment=garment,
            body=bodies,
            garment_faces=self.garment.faces,
            body_faces=self.model.body.faces,
            betas=betas,
            motion=motion,
        )

    def _at_rate(self, motion: Motion) -> Motion:
        if len(motion.skeleton.names) != self.regressor.joints:
            raise ValueError(
                f"motion {motion.name!r} has {len(motion.skeleton.names)} joints, but the networks were trained for "
                f"{self.regressor.joints}; load it with workbench.load_motion(file, body), which retargets it"
            )
        if abs(motion.fps - self.regressor.fps) < 1e-3:
            return motion
        return motion.resampled(self.regressor.fps)


@dataclass(frozen=True)
class Frame:
    """What a stream gives for one frame."""

    latent: Float[Tensor, "L"]
    canonical: Float[Tensor, "N 3"]
    garment: Float[Tensor, "N 3"]


class TryOnStream:
    """`stream(rotations, translation)` -> Frame; keeps the recurrent state and the last frames' descriptor."""

    def __init__(self, tryon: TryOn, betas: Float[Tensor, "K"]):
        self.tryon, self.betas = tryon, betas
        self.pose = frame_poser(tryon.model, betas, tryon.subspace.vertex_count)
        self.describe = DescriptorStream(tryon.regressor.describe, tryon.regressor.fps)
        self.hidden = torch.zeros(LAYERS, 1, HIDDEN)
        # in numpy: of so few numbers, torch's calls would take longer than the work
        self.of_shape = betas.numpy()
        self.centre, self.size = tryon.regressor.centre.numpy(), tryon.regressor.size.numpy()

    @torch.no_grad()
    def __call__(self, rotations: Float[Tensor, "J 3 3"], translation: Float[Tensor, "3"]) -> Frame:
        """The next frame, at the networks' frame rate.

        Errors: ValueError for another skeleton, NaN or infinity; the stream is then as it was before the frame.
        """
        tryon = self.tryon
        if len(rotations) != tryon.regressor.joints:
            raise ValueError(f"the frame has {len(rotations)} joints, but the networks {tryon.regressor.joints}")
        if not (np.isfinite(rotations.numpy()).all() and np.isfinite(translation.numpy()).all()):
            raise ValueError(f"frame {self.describe.frame} holds NaN or infinity; leave it out or repeat the last one")
        gamma = self.describe(rotations, translation).numpy()
        inputs = (np.concatenate([gamma, self.of_shape]) - self.centre) / self.size
        inputs = np.clip(inputs, -FARTHEST_INPUT, FARTHEST_INPUT)
        latent, self.hidden = tryon.networks.regress(torch.from_numpy(inputs), self.hidden)
        X = tryon.networks.decode(latent)
        if tryon.corrective is not None:
            X = X + tryon.corrective(rotations, self.betas, latent)
        return Frame(latent, X, self.pose(X, rotations, translation))


def _check_fit(corrective: PosedCorrective, subspace: Subspace, regressor: Regressor) -> None:
    """ValueError unless the three networks are of one garment and one body."""
    if corrective.garment_name != subspace.garment_name or corrective.vertex_count != subspace.vertex_count:
        raise ValueError(
            f"the corrective is of garment {corrective.garment_name!r} with {corrective.vertex_count} vertices, "
            f"but the subspace of {subspace.garment_name!r} with {subspace.vertex_count}; load what was trained "
            "together"
        )
    if (corrective.joints, corrective.shapes) != (regressor.joints, regressor.shapes):
        raise ValueError(
            f"the corrective is for {corrective.joints} joints and {corrective.shapes} shape components, but the "
            f"regressor for {regressor.joints} and {regressor.shapes}"
        )


def checked_shape(betas: Float[Tensor, "_"], body: Body) -> Float[Tensor, "K"]:
    """betas, if a body can have them.  Raises ValueError for a wrong length, NaN, or a shape far beyond any person."""
    if len(betas) != body.shape_count:
        raise ValueError(f"a shape has {body.shape_count} numbers, got {len(betas)}")
    if not bool(torch.isfinite(betas).all()):
        raise ValueError(f"the shape holds NaN or infinity: {betas.tolist()}")
    worst = int(betas.abs().argmax())
    if float(betas[worst].abs()) > FARTHEST_SHAPE:
        raise ValueError(
            f"shape component {worst} is {float(betas[worst]):g} standard deviations from the mean; beyond "
            f"{FARTHEST_SHAPE:g} the linear body is no body any more: give smaller numbers"
        )
    return betas


@dataclass(frozen=True)
class TryOnConfig:
    """Dress a body in a garment through any motion file."""

    # The name of a garment whose networks ship, such as tshirt, or of one whose networks are in --networks.
    garment: tyro.conf.Positional[str]
    # BVH, AMASS npz, DeepMimic txt, or our own npz.
    motion: Path
    # The dressed sequence, npz.
    out: Path
    # The body's shape, up to 10 numbers in standard deviations, with commas; what is left out is 0.
    betas: str = ""
    # Rotate arms and legs clear of the body first: cloth cannot be where the body overlaps itself.
    clear: bool = True
    # Bridge the frames of capture errors that fold a body in two (loading such a motion warns of them); by default they
    # are dressed as they are.
    mend: bool = False
    # A folder of networks (`workbench train`); those that ship when absent.
    networks: Path | None = None


def run(config: TryOnConfig) -> TryOnResult:
    """Load, clear, dress, write."""
    tryon = load_tryon(config.garment, config.networks)
    body = tryon.model.body
    betas = shape_from_words(config.betas, body)
    motion = load_motion(config.motion, body)
    if config.mend:
        motion = mended(motion)
    if abs(motion.fps - tryon.regressor.fps) > 1e-3:
        motion = motion.resampled(tryon.regressor.fps)
    if config.clear:
        motion = motion.cleared(body, betas=betas)
    result = tryon.run(motion, betas)
    result.save(config.out)
    return result


def load_tryon(garment: str, networks: Path | None) -> TryOn:
    """The networks that ship for a garment, or those of a folder."""
    if networks is None:
        return TryOn.shipped(garment)
    return TryOn.of(
        Subspace.load(networks / f"{garment}-subspace.safetensors"),
        Regressor.load(networks / f"{garment}-regressor.safetensors"),
        corrective=PosedCorrective.beside(networks, garment),
    )


def shape_from_words(words: str, body: Body) -> Float[Tensor, "K"]:
    """ "1,-0.5" -> a full shape vector.  Raises ValueError for what is no number, or too many."""
    try:
        given = [float(word) for word in words.split(",") if word.strip()]
    except ValueError as error:
        raise ValueError(f"--betas {words!r} must be numbers with commas, such as 1,-0.5,2") from error
    if len(given) > body.shape_count:
        raise ValueError(f"{len(given)} betas given, but the body has {body.shape_count} shape components")
    full = body.mean_shape()
    full[: len(given)] = torch.tensor(given)
    return checked_shape(full, body)
