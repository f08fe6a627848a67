"""A field of many channels tabulated on an adaptive grid: p (N,3) -> (N,C), continuous, differentiable in p.

An octree: root cells of one size, a cell split in eight where trilinear interpolation from its corners errs too much.
What is stored is the surplus of each new node over the interpolation of its parent cell, in integers: mostly small,
hence small on disk.  A node on the border to an unsplit cell keeps surplus zero, so the field is continuous.  A lookup
reads the eight corners of one leaf.
"""

import copy
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.store import atomic_write

from .closest_point import run_chunks
from .warp_kernels import locate_in_octree
from .warp_launch import shared_array

CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
LATTICE = np.stack(np.meshgrid([0, 1, 2], [0, 1, 2], [0, 1, 2], indexing="ij"), -1).reshape(27, 3)  # of a split cell
IS_NEW = (LATTICE % 2 == 1).any(1)  # 19 of the 27: not a corner of the parent
FORMAT = 1


@dataclass(frozen=True)
class Refinement:
    """What splitting cells brings: the new nodes, what they interpolate, which are free, and the cells' own corners."""

    key: Int[np.ndarray, "n"]  # of the new nodes, sorted
    place: Int[np.ndarray, "n 3"]  # of the new nodes, in cells of the new level
    parents: Int[np.ndarray, "n 8"]  # node indices
    parent_weights: Float[np.ndarray, "n 8"]
    free: Bool[np.ndarray, "n"]  # every cell around it is split: its value may differ from the interpolation
    node_of: Int[np.ndarray, "m 19"]  # the new nodes of each split cell, as indices into key


@dataclass(frozen=True)
class CompactGrid:
    """The grid as stored: which cells split, and the integer surpluses of the free nodes, level by level."""

    low: Float[np.ndarray, "3"]
    root_size: float
    shape: tuple[int, int, int]
    step: Float[np.ndarray, "C"]  # a surplus is its integer times the step of its channel
    splits: tuple[Bool[np.ndarray, "_"], ...]
    codes: tuple[Int[np.ndarray, "_ C"], ...]
    made_for: str = ""


@dataclass(frozen=True)
class Leaf:
    """Where points lie: corner nodes of their leaf cells, the corners' weights, local coordinates, edge length [m]."""

    nodes: Int[Tensor, "N 8"]
    weights: Float[Tensor, "N 8"]
    local: Float[Tensor, "N 3"]
    size: Float[Tensor, "N"]


class FieldGrid:
    """The expanded table: for lookups.  Box and cells in metres; points outside take the value at the box's border."""

    def __init__(self, compact: CompactGrid):
        self.compact = compact
        _, corners = _root(compact.shape)
        step = compact.step.astype(np.float32)
        values = compact.codes[0].astype(np.float32) * step
        places = nodes_of_cells(compact.shape)
        children = [np.full(len(corners), -1, np.int32)]
        all_corners, first = [corners], 0
        for level, split in enumerate(compact.splits):
            if len(split) != len(places):
                raise ValueError(f"level {level} of the grid has {len(places)} cells, but {len(split)} marks")
            fine = refine(places[split], corners[split], level, compact.shape)
            added = interpolate(values, fine.parents, fine.parent_weights)
            if len(compact.codes[level + 1]) != fine.free.sum():
                raise ValueError(
                    f"level {level + 1} of the grid has {fine.free.sum()} free nodes, but "
                    f"{len(compact.codes[level + 1])} values"
                )
            added[fine.free] += compact.codes[level + 1].astype(np.float32) * step
            next_first = first + len(places)
            children[level][split] = next_first + 8 * np.arange(split.sum(), dtype=np.int32)
            places, corners = split_cells(places[split], corners[split], len(values), fine)
            values = np.concatenate([values, added])
            children.append(np.full(len(places), -1, np.int32))
            all_corners.append(corners)
            first = next_first
        self.child = torch.from_numpy(np.concatenate(children))
        self.corner = torch.from_numpy(np.concatenate(all_corners))
        self.values = torch.from_numpy(values)
        self.depth = len(compact.splits)

    @property
    def channels(self) -> int:
        return self.values.shape[1]

    @cached_property
    def low(self) -> Float[Tensor, "3"]:
        return torch.from_numpy(self.compact.low.astype(np.float32))

    @cached_property
    def high(self) -> Float[Tensor, "3"]:
        return self.low + self.compact.root_size * torch.tensor(self.compact.shape)

    def at(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B C"]:
        """The field at the points (metres)."""
        rows = _Lookup.apply(points.reshape(-1, 3), self)
        return rows.reshape(*points.shape[:-1], self.channels)

    def to(self, device: torch.device) -> "FieldGrid":
        """The same table on another device, for points that are there."""
        moved = copy.copy(self)
        for name in ("child", "corner", "values", "low", "high"):
            setattr(moved, name, getattr(self, name).to(device))
        vars(moved).pop("_double_values", None)
        return moved

    def save(self, path: str | Path) -> None:
        """Write the compact form (npz)."""
        save_compact(self.compact, path)

    @staticmethod
    def load(path: str | Path) -> "FieldGrid":
        """Read what `save` wrote; ValueError for a missing, damaged or foreign file."""
        return FieldGrid(load_compact(path))

    def locate(self, points: Float[Tensor, "N 3"]) -> "Leaf":
        """The leaf cell of each point: by Warp for float32 on the CPU, by torch otherwise (two ways that agree)."""
        if points.dtype == torch.float32 and points.device.type == "cpu":
            return self._locate_by_warp(points)
        return self._locate_by_torch(points)

    def _locate_by_torch(self, points: Float[Tensor, "N 3"]) -> "Leaf":
        shape = torch.tensor(self.compact.shape, device=points.device)
        x = (points - self.low.to(points)) / self.compact.root_size
        x = torch.minimum(x.clamp(min=0), shape.to(points))
        root = torch.minimum(x.long(), shape - 1)
        local = x - root
        cell = (root[:, 0] * shape[1] + root[:, 1]) * shape[2] + root[:, 2]
        size = torch.full_like(local[:, 0], self.compact.root_size)
        digits = torch.tensor([4, 2, 1], device=points.device)
        for _ in range(self.depth):
            down = self.child[cell].long()
            deeper = down >= 0
            octant = (2 * local).long().clamp(max=1)
            cell = torch.where(deeper, down + (octant * digits).sum(1), cell)
            local = torch.where(deeper[:, None], 2 * local - octant, local)
            size = torch.where(deeper, size / 2, size)
        return Leaf(self.corner[cell], trilinear_weights(local), local, size)

    def _locate_by_warp(self, points: Float[Tensor, "N 3"]) -> "Leaf":
        count = len(points)
        nodes, weights = np.empty((count, 8), np.int32), np.empty((count, 8), np.float32)
        local, size = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        if count:
            low, (nx, ny, nz) = self.compact.low, self.compact.shape
            inputs = [
                shared_array(np.ascontiguousarray(points.numpy()), wp.vec3),
                wp.vec3(float(low[0]), float(low[1]), float(low[2])),
                self.compact.root_size,
                wp.vec3i(nx, ny, nz),
                *self._warp_tree,
                shared_array(nodes, wp.int32, 2),
                shared_array(weights, wp.float32, 2),
                shared_array(local, wp.vec3),
                shared_array(size, wp.float32),
            ]

            def launch(start: int, stop: int) -> None:
                wp.launch(locate_in_octree, dim=stop - start, inputs=[start, *inputs], device="cpu", record_tape=False)

            run_chunks(launch, count, chunk=1 << 15)
        return Leaf(*(torch.from_numpy(array) for array in (nodes, weights, local, size)))

    @cached_property
    def _warp_tree(self) -> Any:
        return shared_array(self.child.numpy(), wp.int32), shared_array(self.corner.numpy(), wp.int32, 2)

    @cached_property
    def _double_values(self) -> Tensor:
        return self.values.double()


class _Lookup(torch.autograd.Function):
    """Trilinear interpolation in the leaf: values by one embedding_bag, the gradient by three."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, grid: FieldGrid) -> Tensor:
        points = points.detach()
        if not bool(torch.isfinite(points).all()):
            raise ValueError(f"points must be finite, but {int((~torch.isfinite(points)).any(-1).sum())} are not")
        leaf = grid.locate(points)
        ctx.save_for_backward(leaf.nodes, leaf.local, leaf.size, points)
        ctx.grid = grid
        return weighted_rows(_table(grid, points), leaf.nodes, leaf.weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        nodes, local, size, points = ctx.saved_tensors
        grid, grad = ctx.grid, grad_outputs[0]
        table = _table(grid, points)
        gradient = torch.stack(
            [(weighted_rows(table, nodes, slope) * grad).sum(-1) / size for slope in trilinear_slopes(local)],
            dim=-1,
        )
        outside = (points < grid.low.to(points)) | (points > grid.high.to(points))
        return gradient.masked_fill(outside, 0.0), None


def _table(grid: FieldGrid, points: Tensor) -> Tensor:
    return grid._double_values if points.dtype == torch.float64 else grid.values


def weighted_rows(
    table: Float[Tensor, "M C"], rows: Int[Tensor, "N 8"], weights: Float[Tensor, "N 8"]
) -> Float[Tensor, "N C"]:
    """sum_k weights[n,k] table[rows[n,k]]"""
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def trilinear_weights(local: Float[Tensor, "N 3"]) -> Float[Tensor, "N 8"]:
    """Weights of a cell's corners (CORNERS) at local coordinates in [0, 1]^3."""
    x, y, z = torch.stack([1 - local, local], -1).unbind(1)
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)


def trilinear_slopes(local: Float[Tensor, "N 3"]) -> list[Float[Tensor, "N 8"]]:
    """Derivatives of `trilinear_weights` in the three local coordinates."""
    x, y, z = torch.stack([1 - local, local], -1).unbind(1)
    d = torch.tensor([-1.0, 1.0], dtype=local.dtype, device=local.device).expand_as(x)
    return [
        (a[:, :, None, None] * b[:, None, :, None] * c[:, None, None, :]).flatten(1)
        for a, b, c in ((d, y, z), (x, d, z), (x, y, d))
    ]


# Building


@dataclass(frozen=True)
class GridConfig:
    """How a field is tabulated: root cells of `root_size` metres, split `depth` times at most."""

    root_size: float = 0.128
    depth: int = 4
    worth_asking: float = (
        1.5  # a cell is examined only where its parent's error was this many tolerances (it falls 4-fold)
    )


@dataclass(frozen=True)
class Quantisation:
    """Step of each channel; the channels of `simplex` (start, stop) keep a sum of exactly 1 and stay >= 0."""

    step: Float[np.ndarray, "C"]
    simplex: tuple[int, int] | None = None

    def encode(self, exact: Float[np.ndarray, "n C"], interpolated: Float[np.ndarray, "n C"]) -> Int[np.ndarray, "n C"]:
        """Integers k with interpolated + k step ~ exact."""
        code = np.rint((exact - interpolated) / self.step).astype(np.int32)
        if self.simplex is not None and len(code):
            part = slice(*self.simplex)
            step, base = self.step[part], interpolated[:, part]
            piece = np.maximum(code[:, part], np.ceil(-base / step - 1e-6).astype(np.int32))
            missing = np.rint((1 - base.sum(1)) / step[0]).astype(np.int32) - piece.sum(1)
            largest = (base + piece * step).argmax(1)
            piece[np.arange(len(piece)), largest] += missing
            code[:, part] = piece
        return code


def tabulate(
    field: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n C"]],
    error: Callable[[Float[np.ndarray, "m C"], Float[np.ndarray, "m 3"]], Float[np.ndarray, "m"]],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    quantisation: Quantisation,
    config: GridConfig,
    *,
    made_for: str = "",
    progress: Callable[[int, int, int], None] | None = None,
) -> FieldGrid:
    """Tabulate `field` over the box [low, high] (grown to whole root cells).

    `error(surplus, points)` says how many tolerances a deviation is at a point: cells err at most about 1 afterwards,
    or have reached the last level.  `progress(level, cells examined, nodes evaluated)` reports.
    """
    low = np.asarray(low, np.float64)
    shape = tuple(int(n) for n in np.maximum(1, np.ceil((high - low) / config.root_size - 1e-6)))
    assert len(shape) == 3
    nodes, corners = _root(shape)
    exact = field((low + config.root_size * nodes).astype(np.float32))
    step = quantisation.step.astype(np.float32)
    codes = [quantisation.encode(exact, np.zeros_like(exact))]
    values = codes[0].astype(np.float32) * step
    places = nodes_of_cells(shape)
    ask = np.ones(len(places), bool)
    splits: list[np.ndarray] = []
    for level in range(config.depth):
        candidate = refine(places[ask], corners[ask], level, shape)
        points = (low + config.root_size / 2 ** (level + 1) * candidate.place).astype(np.float32)
        exact = field(points)
        surplus = exact - interpolate(values, candidate.parents, candidate.parent_weights)
        errors = error(surplus, points)[candidate.node_of]  # (cells asked, 19)
        split = np.zeros(len(places), bool)
        split[ask] = errors.max(1, initial=0) > 1
        fine = refine(places[split], corners[split], level, shape)
        interpolated = interpolate(values, fine.parents, fine.parent_weights)
        known = exact[np.searchsorted(candidate.key, fine.key)]
        code = quantisation.encode(known[fine.free], interpolated[fine.free])
        added = interpolated
        added[fine.free] += code.astype(np.float32) * step
        octants = _octant_errors(errors[split[ask]])
        ask = (octants > config.worth_asking).ravel()
        places, corners = split_cells(places[split], corners[split], len(values), fine)
        values = np.concatenate([values, added])
        splits.append(split)
        codes.append(code)
        if progress is not None:
            progress(level, len(candidate.node_of), len(points))
    compact = CompactGrid(low, config.root_size, shape, step, tuple(splits), tuple(codes), made_for)
    return FieldGrid(compact)


def _octant_errors(errors: Float[np.ndarray, "m 19"]) -> Float[np.ndarray, "m 8"]:
    """The largest error among the new nodes around each of a cell's eight children."""
    lattice = LATTICE[IS_NEW]
    touching = [(np.abs(lattice - 2 * corner) <= 1).all(-1) for corner in CORNERS]
    return np.stack([errors[:, nodes].max(1, initial=0) for nodes in touching], axis=1)


def refine(
    places: Int[np.ndarray, "m 3"], corners: Int[np.ndarray, "m 8"], level: int, shape: tuple[int, int, int]
) -> Refinement:
    """The nodes that splitting cells of `level` adds.  places: their lower corners, in cells of that level."""
    extent = np.array(shape, np.int64) << (level + 1)  # of the box, in cells of the new level
    stride = np.array([(extent[1] + 1) * (extent[2] + 1), extent[2] + 1, 1])
    lattice = LATTICE[IS_NEW]
    every = (2 * places @ stride)[:, None] + lattice @ stride
    key, index, inverse, count = np.unique(every, return_index=True, return_inverse=True, return_counts=True)
    cell, which = np.divmod(index, len(lattice))
    place = np.stack([key // stride[0], key // stride[1] % (extent[1] + 1), key % (extent[2] + 1)], axis=1)
    # weights of the parent's corners at the lattice point: products of (1 - t, t) with t in {0, 1/2, 1}
    t = (lattice / 2).astype(np.float32)
    table = np.prod(np.where(CORNERS[None] == 1, t[:, None], 1 - t[:, None]), axis=-1)  # (19, 8)
    inner = (place > 0) & (place < extent)
    around = np.where((place % 2 == 0) & inner, 2, 1).prod(1)  # cells of `level` that touch the node
    return Refinement(
        key=key,
        place=place,
        parents=corners[cell],
        parent_weights=table[which],
        free=count == around,
        node_of=inverse.reshape(len(places), len(lattice)),
    )


def split_cells(
    places: Int[np.ndarray, "m 3"], corners: Int[np.ndarray, "m 8"], node_count: int, fine: Refinement
) -> tuple[Int[np.ndarray, "c 3"], Int[np.ndarray, "c 8"]]:
    """The eight children of each cell, in the order of CORNERS: their places and corner nodes."""
    nodes = np.empty((len(places), 27), np.int32)
    nodes[:, IS_NEW] = node_count + fine.node_of
    nodes[:, ~IS_NEW] = corners
    positions = CORNERS[:, None] + CORNERS[None]  # (child, corner, axis) on the 3 x 3 x 3 lattice
    children = nodes[:, (positions * [9, 3, 1]).sum(-1)]
    return (2 * places[:, None] + CORNERS).reshape(-1, 3), children.reshape(-1, 8)


def interpolate(
    values: Float[np.ndarray, "n C"], nodes: Int[np.ndarray, "m 8"], weights: Float[np.ndarray, "m 8"]
) -> Float[np.ndarray, "m C"]:
    """sum_k weights[m,k] values[nodes[m,k]]"""
    return weighted_rows(*(torch.from_numpy(array) for array in (values, nodes, weights))).numpy()


def nodes_of_cells(shape: tuple[int, int, int]) -> Int[np.ndarray, "m 3"]:
    """Lower corner of each root cell, in cells."""
    return np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)


def _root(shape: tuple[int, int, int]) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, "m 8"]]:
    """Nodes of the root cells, and each cell's eight corners among them."""
    nx, ny, nz = (n + 1 for n in shape)
    nodes = nodes_of_cells((nx, ny, nz))
    corner = nodes_of_cells(shape)[:, None] + CORNERS
    return nodes, ((corner[..., 0] * ny + corner[..., 1]) * nz + corner[..., 2]).astype(np.int32)


# On disk


def save_compact(compact: CompactGrid, path: str | Path) -> None:
    """npz: marks as bits; integers byte by byte, for the higher bytes are nearly all zero."""
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "low": compact.low,
        "root_size": np.array(compact.root_size),
        "shape": np.array(compact.shape),
        "step": compact.step,
        "depth": np.array(len(compact.splits)),
        "made_for": np.array(compact.made_for),
    }
    for level, split in enumerate(compact.splits):
        arrays[f"split_{level}"] = np.packbits(split)
        arrays[f"cells_{level}"] = np.array(len(split))
    for level, code in enumerate(compact.codes):
        folded = np.where(code < 0, -2 * code - 1, 2 * code).astype("<u4")  # small numbers, whatever their sign
        planes = folded.T.copy().view(np.uint8).reshape(*folded.T.shape, 4)
        arrays[f"codes_{level}"] = np.moveaxis(planes, -1, 0)  # by significance, channel by channel: zeros in long runs
    with atomic_write(path) as part:
        np.savez_compressed(part, **arrays)


def load_compact(path: str | Path) -> CompactGrid:
    """Read `save_compact`'s file; ValueError for a missing, damaged or foreign one."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no grid {path}; make it with `python -m assets_gen checkpoints`")
    try:
        with np.load(path, allow_pickle=False) as file:
            if "format" not in file.files or int(file["format"]) != FORMAT:
                raise ValueError("it holds no grid of this format")
            depth = int(file["depth"])
            splits = [
                np.unpackbits(file[f"split_{level}"], count=int(file[f"cells_{level}"])).astype(bool)
                for level in range(depth)
            ]
            codes = []
            for level in range(depth + 1):
                planes = np.moveaxis(file[f"codes_{level}"], 0, -1)
                folded = np.ascontiguousarray(planes).view("<u4")[..., 0].astype(np.int32)
                codes.append(np.ascontiguousarray(np.where(folded & 1, -(folded >> 1) - 1, folded >> 1).T))
            nx, ny, nz = (int(n) for n in file["shape"])
            return CompactGrid(
                file["low"],
                float(file["root_size"]),
                (nx, ny, nz),
                file["step"],
                tuple(splits),
                tuple(codes),
                str(file["made_for"]),
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"grid {path} is unusable ({error}); make it again with `python -m assets_gen checkpoints`"
        ) from error
