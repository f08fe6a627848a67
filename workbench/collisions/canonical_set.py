"""Sec. 4.4: projected ground truth in a compact form.  X (T,N,3), theta, beta of many sequences <-> one file.

Garments are stored as a mean, a linear basis (the principal components of all kept frames) and coefficients in whole
numbers, so that anyone retrains without simulating.  What the form loses is measured when it is made and stored beside.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.garments import Garment
from workbench.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from workbench.npz import read_npz
from workbench.store import atomic_write

FORMAT = "canonical-set-1"
STEP = 2e-5  # metres of root-mean-square vertex movement that one unit of a coefficient means
BASIS_STEP = 1e-4  # metres: rounding of a basis row moves a vertex by at most half of it, at its largest coefficient
STORED = (
    *("format", "garment", "mean", "basis", "basis_step", "coefficients", "rotations", "translation", "valid"),
    *("lengths", "betas", "motions", "splits", "fps", "error"),
)
SHIPPED = Path(__file__).parents[1] / "assets" / "training"


@dataclass(frozen=True, eq=False)
class CanonicalSequence:
    """A garment in canonical space through one motion on one shape, by coefficients of the set's basis."""

    coefficients: Float[Tensor, "T R"]
    rotations: Float[Tensor, "_ J 3 3"]  # theta; _ is T
    translation: Float[Tensor, "_ 3"]
    betas: Float[Tensor, " K"]
    valid: Bool[Tensor, " _"]  # the simulation kept the frame
    motion_name: str
    split: str  # train or validation; test sequences ship exactly (SimulatedSequence)

    def __len__(self) -> int:
        return len(self.coefficients)

    def to(self, device: torch.device) -> "CanonicalSequence":
        """The same on a device."""
        return replace(
            self,
            coefficients=self.coefficients.to(device),
            rotations=self.rotations.to(device),
            translation=self.translation.to(device),
            betas=self.betas.to(device),
            valid=self.valid.to(device),
        )


@dataclass(frozen=True, eq=False)
class CanonicalSet:
    """Projected sequences of one garment: X = mean + coefficients . basis.  Metres; basis rows: RMS 1 a vertex."""

    garment_name: str
    mean: Float[Tensor, "N 3"]
    basis: Float[Tensor, "R N 3"]
    sequences: tuple[CanonicalSequence, ...]
    fps: float
    error: float  # metres, root mean square over the vertices of all kept frames, of basis and rounding
    own_garment: Garment | None = None  # where it is none of those that ship

    @cached_property
    def garment(self) -> Garment:
        """Template and topology.  Raises ValueError when the garment has another vertex count."""
        garment = self.own_garment or Garment.load(self.garment_name)
        if len(garment.vertices) != len(self.mean):
            raise ValueError(
                f"the training set has {len(self.mean)} vertices, but garment {self.garment_name!r} "
                f"{len(garment.vertices)}; it was made for another garment"
            )
        return garment

    @property
    def rank(self) -> int:
        return len(self.basis)

    @cached_property
    def flat_basis(self) -> Float[Tensor, "R N3"]:
        return self.basis.flatten(1)

    def garments(self, coefficients: Float[Tensor, "*B R"]) -> Float[Tensor, "*B N 3"]:
        """X from coefficients."""
        return self.mean + (coefficients @ self.flat_basis).unflatten(-1, (-1, 3))

    def coefficients_of(self, garments: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B R"]:
        """The coefficients nearest to X (the basis is orthogonal, of squared length N)."""
        return (garments - self.mean).flatten(-2) @ self.flat_basis.T / len(self.mean)

    def to(self, device: torch.device) -> "CanonicalSet":
        """The same on a device."""
        return replace(
            self,
            mean=self.mean.to(device),
            basis=self.basis.to(device),
            sequences=tuple(sequence.to(device) for sequence in self.sequences),
        )

    def of_split(self, split: str) -> tuple[CanonicalSequence, ...]:
        return tuple(sequence for sequence in self.sequences if sequence.split == split)

    def kept(self, split: str) -> Float[Tensor, "M R"]:
        """Coefficients of all kept frames of a split.  Raises ValueError when there are none."""
        parts = [sequence.coefficients[sequence.valid] for sequence in self.of_split(split)]
        if not parts or not sum(map(len, parts)):
            known = sorted({sequence.split for sequence in self.sequences})
            raise ValueError(f"the set of {self.garment_name!r} has no kept frames for {split!r}; it has {known}")
        return torch.cat(parts)

    def save(self, path: str | Path) -> None:
        """npz, written whole or not at all: a basis row in steps that its largest coefficient makes BASIS_STEP,
        coefficients in steps of STEP, rotations in 16 bits."""
        amounts = torch.cat([s.coefficients for s in self.sequences])
        basis_step = BASIS_STEP / amounts.abs().amax(dim=0).clamp_min(BASIS_STEP)
        coded = torch.round(self.basis / basis_step[:, None, None]).to(torch.int32)
        coefficients = torch.round(amounts / STEP).to(torch.int32)
        turned = matrix_to_quaternion(torch.cat([s.rotations for s in self.sequences]).double())
        arrays = {
            "format": np.array(FORMAT),
            "garment": np.array(self.garment_name),
            "mean": self.mean.numpy(),
            "basis": _planes(coded.transpose(1, 2).flatten(1).numpy()),
            "basis_step": basis_step.numpy(),
            "coefficients": _planes(coefficients.T.contiguous().numpy()),
            "rotations": _planes(np.round(turned.numpy() * 32767).astype(np.int16).reshape(len(turned), -1).T),
            "translation": torch.cat([s.translation for s in self.sequences]).numpy().astype(np.float32),
            "valid": torch.cat([s.valid for s in self.sequences]).numpy(),
            "lengths": np.array([len(s) for s in self.sequences]),
            "betas": torch.stack([s.betas for s in self.sequences]).numpy(),
            "motions": np.array([s.motion_name for s in self.sequences]),
            "splits": np.array([s.split for s in self.sequences]),
            "fps": np.array(self.fps),
            "error": np.array(self.error),
        }
        if self.own_garment is not None:
            arrays |= {name: tensor.numpy() for name, tensor in self.own_garment.tensors().items()}
        with atomic_write(path) as part:
            np.savez_compressed(part, **arrays)

    @staticmethod
    def load(path: str | Path) -> "CanonicalSet":
        """Raises FileNotFoundError, or ValueError for anything that `save` did not write."""
        arrays = read_npz(path, "a set of canonical garments", required=STORED)
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"{path} has format {str(arrays['format'])!r}; expected {FORMAT!r}")
        lengths = [int(n) for n in arrays["lengths"]]
        basis = _joined(arrays["basis"], np.int32).astype(np.float32) * arrays["basis_step"][:, None]
        coefficients = torch.from_numpy(_joined(arrays["coefficients"], np.int32).T.astype(np.float32) * STEP)
        joints = len(arrays["rotations"]) // 4
        quaternions = _joined(arrays["rotations"], np.int16).T.reshape(-1, joints, 4).astype(np.float64)
        quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
        rotations = quaternion_to_matrix(torch.from_numpy(quaternions)).float()
        whole = (coefficients, rotations, torch.from_numpy(arrays["translation"]), torch.from_numpy(arrays["valid"]))
        if any(len(tensor) != sum(lengths) for tensor in whole):
            raise ValueError(f"{path}: its arrays hold {[len(t) for t in whole]} frames, its lengths {sum(lengths)}")
        parts = zip(*(tensor.split(lengths) for tensor in whole), strict=True)
        name = str(arrays["garment"])
        packed = {key: torch.from_numpy(value) for key, value in arrays.items() if key.startswith("garment.")}
        return CanonicalSet(
            garment_name=name,
            mean=torch.from_numpy(arrays["mean"]),
            basis=torch.from_numpy(basis).unflatten(1, (3, -1)).transpose(1, 2).contiguous(),
            sequences=tuple(
                CanonicalSequence(amounts, turned, moved, torch.from_numpy(betas), valid, str(motion), str(split))
                for (amounts, turned, moved, valid), betas, motion, split in zip(
                    parts, arrays["betas"], arrays["motions"], arrays["splits"], strict=True
                )
            ),
            fps=float(arrays["fps"]),
            error=float(arrays["error"]),
            own_garment=Garment.from_tensors(name, packed),
        )

    @staticmethod
    def shipped(garment_name: str) -> "CanonicalSet":
        """The set that ships for a garment.  Raises ValueError naming those there are."""
        path = SHIPPED / f"{garment_name}.npz"
        if not path.is_file():
            known = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.npz"))) or "none"
            raise ValueError(f"no training set of garment {garment_name!r} ships; there are: {known}")
        return CanonicalSet.load(path)


@dataclass(frozen=True, eq=False)
class Projected:
    """One projected sequence, vertex by vertex: what `compact` takes."""

    canonical: Float[Tensor, "T N 3"]
    sequence: CanonicalSequence  # its coefficients are still empty


def compact(
    projected: Sequence[Projected], garment: Garment, fps: float, *, rank: int, generator: torch.Generator
) -> CanonicalSet:
    """Mean and principal components of all kept frames given (training and validation, never test); coefficients.

    Errors: ValueError for no kept frame, or sequences of different vertex counts.
    """
    counts = {one.canonical.shape[1] for one in projected}
    if len(counts) != 1:
        raise ValueError(f"all sequences must be of one garment; got vertex counts {sorted(counts)}")
    kept = [one.canonical[one.sequence.valid] for one in projected]
    if not sum(map(len, kept)):
        raise ValueError("no frame was kept: there is nothing to make a basis of")
    frames = torch.cat(kept)
    mean = frames.mean(dim=0)
    basis = principal_components((frames - mean).flatten(1), rank, generator).unflatten(1, (-1, 3))
    own = None if garment.ships else garment
    empty = CanonicalSet(garment.name, mean, basis, (), fps, 0.0, own)
    sequences = tuple(
        replace(one.sequence, coefficients=_rounded(empty.coefficients_of(one.canonical))) for one in projected
    )
    errors = [
        (empty.garments(s.coefficients) - one.canonical)[s.valid].square().sum(-1).flatten()
        for one, s in zip(projected, sequences, strict=True)
    ]
    return replace(empty, sequences=sequences, error=float(torch.cat(errors).mean().sqrt()))


def principal_components(rows: Float[Tensor, "M D"], rank: int, generator: torch.Generator) -> Float[Tensor, "R D"]:
    """The leading right singular vectors, scaled to a mean square of 1 a vertex (three numbers); by random projection.

    Halko, Martinsson and Tropp 2011, with two power iterations; cost M D (rank + 16).
    """
    rank = min(rank, *rows.shape)
    width = min(rank + 16, *rows.shape)
    sketch = torch.randn(rows.shape[1], width, generator=generator)
    for _ in range(3):
        tall = torch.linalg.qr(rows @ sketch).Q
        sketch = torch.linalg.qr(rows.T @ tall).Q
    small = rows @ sketch
    _, _, turn = torch.linalg.svd(small, full_matrices=False)
    components = (sketch @ turn.T).T[:rank]
    return components * np.sqrt(rows.shape[1] / 3)


def _rounded(coefficients: Float[Tensor, "T R"]) -> Float[Tensor, "T R"]:
    return torch.round(coefficients / STEP) * STEP


def _planes(values: Int[np.ndarray, "A B"]) -> np.ndarray:
    """Differences along rows, folded to small unsigned numbers, byte by byte: the upper bytes are nearly all zero."""
    wide = values.astype(np.int64)
    step = np.diff(wide, axis=1, prepend=0)
    folded = np.where(step < 0, -2 * step - 1, 2 * step).astype("<u4")
    bytes_ = np.ascontiguousarray(folded)[..., None].view(np.uint8)  # (A, B, 4)
    used = max(1, 4 - int((bytes_.reshape(-1, 4).max(0)[::-1] == 0).argmin()))
    return np.moveaxis(bytes_[..., :used], -1, 1)  # (A, bytes, B)


def _joined(planes: np.ndarray, kind: type) -> np.ndarray:
    """Inverse of `_planes`."""
    rows, used, length = planes.shape
    whole = np.zeros((rows, length, 4), np.uint8)
    whole[..., :used] = np.moveaxis(planes, 1, -1)
    folded = whole.view("<u4")[..., 0].astype(np.int64)
    step = np.where(folded & 1, -(folded >> 1) - 1, folded >> 1)
    return np.cumsum(step, axis=1).astype(kind)
