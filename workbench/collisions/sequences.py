"""Sec. 6: simulated frames, the ground truth of everything after.  file <-> M_G (T,N,3), theta (T,J,3,3), beta (K,).

Storage: positions relative to the root are rounded to 0.03 mm, and each is predicted from its own last frame and its
neighbour's movement; what is left are small integers that compress to about 2 bytes a vertex and frame. Lossless
after rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from torch import Tensor

from workbench.geometry.mesh import unique_edges
from workbench.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from workbench.npz import read_npz
from workbench.store import atomic_write

STORAGE_STEP = 3e-5  # metres; the stored error is at most half of it (the contract's bound: 0.02 mm)
FORMAT = "simulated-sequence-1"
STORED = ("format", "step", "residual", "rotations", "translation", "betas", "faces", "valid", "fps", "names")
SHIPPED = Path(__file__).parents[1] / "assets" / "sequences"
SHIPPED_TESTS = SHIPPED.with_name("test_sequences")  # of motions and shapes that no training saw


@dataclass(frozen=True, eq=False)
class SimulatedSequence:
    """A garment simulated on one body shape through one motion, at `fps`; metres, radians."""

    garment: Float[Tensor, "T N 3"]
    rotations: Float[Tensor, "_ J 3 3"]  # theta (T,J,3,3): local rotations; _ is T, whose agreement is checked below
    translation: Float[Tensor, "_ 3"]
    betas: Float[Tensor, " K"]
    faces: Int[Tensor, "F 3"]
    valid: Bool[Tensor, " _"]  # the frame passed the quality check: nothing inside the body, stretch within bounds
    fps: float
    garment_name: str
    motion_name: str
    made_by: str = ""  # JSON: what made it (configuration, scores)

    def __post_init__(self) -> None:
        T = len(self.garment)
        for name in ("rotations", "translation", "valid"):
            got = len(getattr(self, name))
            if got != T:
                raise ValueError(f"{name} has {got} frames, but the garment has {T}")

    def __len__(self) -> int:
        return len(self.garment)

    def clip(self, start: int, stop: int) -> "SimulatedSequence":
        """Frames start..stop-1."""
        part = slice(start, stop)
        return SimulatedSequence(
            garment=self.garment[part],
            rotations=self.rotations[part],
            translation=self.translation[part],
            betas=self.betas,
            faces=self.faces,
            valid=self.valid[part],
            fps=self.fps,
            garment_name=self.garment_name,
            motion_name=self.motion_name,
            made_by=self.made_by,
        )

    def save(self, path: str | Path) -> None:
        """Compact npz, written whole or not at all; positions within 0.015 mm, rotations within 1e-6."""
        ticks = quantise(self.garment, self.translation)
        tree = spanning_tree(self.faces.numpy(), self.garment.shape[1])
        small = zigzag(predict(ticks, tree))
        arrays = {
            "format": np.array(FORMAT),
            "step": np.array(STORAGE_STEP),
            "rotations": matrix_to_quaternion(self.rotations).numpy().astype(np.float32),
            "translation": self.translation.numpy(),
            "betas": self.betas.numpy(),
            "faces": self.faces.numpy().astype(np.int32),
            "valid": self.valid.numpy(),
            "fps": np.array(self.fps),
            "names": np.array([self.garment_name, self.motion_name, self.made_by]),
        }
        # The bytes of one significance lie together, vertex by vertex through time: the upper ones are nearly all zero.
        planes = 1 if small.max(initial=0) < 256 else 2 if small.max(initial=0) < 65536 else 4
        stacked = np.ascontiguousarray(small.transpose(2, 1, 0)).astype(f"<u{planes}")
        arrays["residual"] = np.moveaxis(stacked[..., None].view(np.uint8), -1, 0)
        with atomic_write(path) as part:
            np.savez_compressed(part, **arrays)

    @staticmethod
    def load(path: str | Path) -> "SimulatedSequence":
        """Raises FileNotFoundError, or ValueError for anything that `save` did not write."""
        arrays = read_npz(path, "a simulated sequence", required=STORED)
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"{path} has format {str(arrays['format'])!r}; expected {FORMAT!r}")
        faces = arrays["faces"].astype(np.int64)
        planes = arrays["residual"]  # (bytes, 3, N, T)
        stacked = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(f"<u{len(planes)}")[..., 0]
        residual = unzigzag(stacked.transpose(2, 1, 0).astype(np.uint32))
        ticks = restore(residual, spanning_tree(faces, residual.shape[1]))
        translation = torch.from_numpy(arrays["translation"])
        positions = torch.from_numpy(ticks * float(arrays["step"])) + translation.double()[:, None]
        garment_name, motion_name, made_by = (str(name) for name in arrays["names"])
        return SimulatedSequence(
            garment=positions.float(),
            rotations=quaternion_to_matrix(torch.from_numpy(arrays["rotations"])),
            translation=translation,
            betas=torch.from_numpy(arrays["betas"]),
            faces=torch.from_numpy(faces),
            valid=torch.from_numpy(arrays["valid"]),
            fps=float(arrays["fps"]),
            garment_name=garment_name,
            motion_name=motion_name,
            made_by=made_by,
        )


def shipped_sequences() -> list[SimulatedSequence]:
    """Every simulated sequence that ships, by file name."""
    return [SimulatedSequence.load(path) for path in sorted(SHIPPED.glob("*.npz"))]


def tests_of(garment_name: str, folder: Path | None) -> list[SimulatedSequence]:
    """The test sequences of a garment: those that ship, or those that `assets_gen dataset` left in a folder."""
    if folder is None:
        return shipped_tests(garment_name)
    return [SimulatedSequence.load(path) for path in sorted(folder.glob(f"{garment_name}-test_*.npz"))]


def shipped_tests(garment_name: str) -> list[SimulatedSequence]:
    """The simulated test sequences of a garment that ship, by file name; motions and shapes that no training saw."""
    return [SimulatedSequence.load(path) for path in sorted(SHIPPED_TESTS.glob(f"{garment_name}_*.npz"))]


def shipped_sequence(name: str) -> SimulatedSequence:
    """The shipped sequence of that file name, such as "tshirt_demo".  Raises ValueError naming those there are."""
    path = SHIPPED / f"{name}.npz"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in SHIPPED.glob("*.npz"))) or "none"
        raise ValueError(f"no sequence {name!r} ships; there are: {known}")
    return SimulatedSequence.load(path)


@dataclass(frozen=True, eq=False)
class SpanningTree:
    """Each vertex hangs on a neighbour; levels lists the vertices by their distance from the root."""

    parent: Int[np.ndarray, " N"]  # -1 for a root
    levels: tuple[np.ndarray, ...]


def spanning_tree(faces: Int[np.ndarray, "F 3"], vertex_count: int) -> SpanningTree:
    """Breadth first from the lowest vertex of each connected part; the same faces always give the same tree."""
    edges = unique_edges(torch.from_numpy(np.asarray(faces, dtype=np.int64))).numpy()
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(vertex_count,) * 2).tocsr()
    graph = graph + graph.T
    parent, depth = np.full(vertex_count, -1), np.zeros(vertex_count, dtype=np.int64)
    part = connected_components(graph, directed=False)[1]
    for root in np.unique(part, return_index=True)[1]:
        order, before = breadth_first_order(graph, root, directed=False)
        parent[order[1:]] = before[order[1:]]
        for vertex in order[1:]:
            depth[vertex] = depth[parent[vertex]] + 1
    by_depth = np.argsort(depth, kind="stable")
    return SpanningTree(parent, tuple(np.split(by_depth, np.cumsum(np.bincount(depth))[:-1])))


def quantise(garment: Float[Tensor, "T N 3"], translation: Float[Tensor, "T 3"]) -> Int[np.ndarray, "T N 3"]:
    """Positions relative to the root in steps of STORAGE_STEP."""
    relative = garment.double() - translation.double()[:, None]
    if not bool(torch.isfinite(relative).all()):
        raise ValueError("the garment has NaN or infinite positions; a diverged simulation cannot be stored")
    return torch.round(relative / STORAGE_STEP).to(torch.int32).numpy()


def predict(ticks: Int[np.ndarray, "T N 3"], tree: SpanningTree) -> Int[np.ndarray, "T N 3"]:
    """What two predictions leave: `as in the last frame`, then `moved as its parent did`."""
    moved = np.diff(ticks, axis=0, prepend=0)
    hanging = tree.parent >= 0
    residual = moved.copy()
    residual[:, hanging] -= moved[:, tree.parent[hanging]]
    return residual


def restore(residual: Int[np.ndarray, "T N 3"], tree: SpanningTree) -> Int[np.ndarray, "T N 3"]:
    """Inverse of `predict`."""
    moved = residual.copy()
    for level in tree.levels[1:]:
        moved[:, level] += moved[:, tree.parent[level]]
    return np.cumsum(moved, axis=0, dtype=np.int32)


def zigzag(signed: Int[np.ndarray, "*S"]) -> UInt[np.ndarray, "*S"]:
    """0, -1, 1, -2 ... -> 0, 1, 2, 3 ...: small magnitudes become small unsigned numbers."""
    return ((signed << 1) ^ (signed >> 31)).astype(np.uint32)


def unzigzag(unsigned: UInt[np.ndarray, "*S"]) -> Int[np.ndarray, "*S"]:
    return ((unsigned >> 1) ^ (0 - (unsigned & 1))).astype(np.int32)


@dataclass(frozen=True)
class Split:
    train: tuple[SimulatedSequence, ...]
    validation: tuple[SimulatedSequence, ...]
    test: tuple[SimulatedSequence, ...]


def split_by_motion(
    sequences: Sequence[SimulatedSequence],
    generator: np.random.Generator,
    validation_share: float = 0.1,
    test_share: float = 0.2,
) -> Split:
    """No motion on two sides: all shapes and garments of a motion go together. Shares count motions, rounded.

    Raises:
        ValueError: shares that leave nothing to train on.
    """
    motions = sorted({sequence.motion_name for sequence in sequences})
    held_validation, held_test = round(validation_share * len(motions)), round(test_share * len(motions))
    if min(validation_share, test_share) < 0 or held_validation + held_test >= max(len(motions), 1):
        raise ValueError(
            f"{len(motions)} motions cannot give {held_validation} to validation and {held_test} to test and keep some"
            " to train; lower the shares or simulate more motions"
        )
    shuffled = [motions[i] for i in generator.permutation(len(motions))]
    test, validation = set(shuffled[:held_test]), set(shuffled[held_test : held_test + held_validation])
    return Split(
        train=tuple(s for s in sequences if s.motion_name not in test | validation),
        validation=tuple(s for s in sequences if s.motion_name in validation),
        test=tuple(s for s in sequences if s.motion_name in test),
    )
