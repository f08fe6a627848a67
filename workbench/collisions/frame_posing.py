"""Eq. 7-8, frame by frame, for one shape.  canonical X (N,3), theta (J,3,3), H (3) -> posed garment (N,3).

`TablePoser` computes what `GarmentModel` computes with `GridFields`, in a tenth of the time: a node's B~s is contracted
with beta once, when the first garment reaches the node, into a compact copy of the rows that this garment needs.  Every
frame, kernels find the points' cells, turn each row that these need into its map of rest points, once and in the order
of memory, and blend the maps of a point's eight rows: Eq. 7-8 are linear in the fields.
"""

from abc import ABC, abstractmethod

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.posing_kernels import (
    LANES,
    SOME,
    SUMS,
    TRIPLES,
    blend_rows,
    find_leaves,
    joint_transforms,
    mark_rows,
    pose_points,
)
from workbench.geometry.closest_point import morton_order
from workbench.geometry.warp_launch import Recorded, shared_array

CODES = 32767  # the largest integer of 16 bits
LINE = 64  # bytes of a cache line
NEVER = -1  # the frame of what no frame asked for
SLACK = 5e-4  # metres by which the table's rounding can go beyond the fields


class FramePoser(ABC):
    """M_G of one shape and one garment."""

    @abstractmethod
    def __call__(
        self, X: Float[Tensor, "N 3"], rotations: Float[Tensor, "J 3 3"], translation: Float[Tensor, "3"]
    ) -> Float[Tensor, "N 3"]:
        """The posed garment.  Raises ValueError where X is not finite."""


class ModelPoser(FramePoser):
    """By the garment model as it is, whatever its fields."""

    def __init__(self, model: GarmentModel, betas: Float[Tensor, "K"]):
        self.model, self.betas = model, betas

    def __call__(
        self, X: Float[Tensor, "N 3"], rotations: Float[Tensor, "J 3 3"], translation: Float[Tensor, "3"]
    ) -> Float[Tensor, "N 3"]:
        return self.model.posed(X, self.model.state(rotations, self.betas, translation))


class NodeRows:
    """The rows of those nodes of the table that were asked for.

    W~ where it is not zero; B~s, contracted with beta, beside the directions of B~p, as integers of 16 bits times a
    step each (an error of a few micrometres at most), in whole chunks.
    Grows by need; it never holds more rows than the table has nodes.
    """

    def __init__(self, body: Body, fields: GridFields, betas: Float[Tensor, "K"]):
        self.fields, self.betas = fields, betas
        layout, grid = fields.layout, fields.grid
        self.offset_chunks = -(-(1 + layout.poses) // TRIPLES)
        # the fields are averages over the body's surface: no larger anywhere than at its vertices
        shape, pose = body.shape_offsets(betas), body.pose_directions.abs().amax((1, 2))
        highest = torch.cat([shape.abs().amax()[None] + SLACK * betas.abs().sum(), pose + SLACK])
        self.step = (highest.clamp_min(1e-9) / CODES).numpy()  # of a displacement, metres
        self.child = grid.child.numpy().copy()  # of a leaf: -1, or -2 - its number here
        self.place = np.full(len(grid.values), -1, np.int32)  # of a node's row here
        # the joints that carry a row, and their W~; where those of each row begin, at last where they end
        self.carriers, self.weights = np.empty(0, np.uint16), np.empty(0, np.float32)
        self.begins = np.zeros(1, np.int32)
        self.offsets = np.empty((0, LANES * self.offset_chunks), np.int16)
        self.asked = np.empty(0, np.int32)  # the last frame that asked for a row
        self.maps = np.empty((0, LANES), np.float32)  # what the row was in that frame
        self.corners = np.empty((0, 8), np.int32)  # rows of a numbered leaf
        self.row_count = self.leaf_count = 0

    def add(self, cells: Int[np.ndarray, "c"]) -> None:
        """Number the leaf cells and read the rows of their corners."""
        nodes = self.fields.grid.corner.numpy()[cells]
        new = np.unique(nodes[self.place[nodes] < 0])
        rows, leaves = self.row_count + len(new), self.leaf_count + len(cells)
        self.offsets = _with_room(self.offsets, rows)
        had, self.asked = len(self.asked), _with_room(self.asked, rows)
        self.asked[had:] = NEVER
        self.maps = _with_room(self.maps, rows)
        self.corners = _with_room(self.corners, leaves)
        # in numpy: of so few numbers, torch's calls would take longer than the work
        layout, values = self.fields.layout, self.fields.grid.values.numpy()[new]
        weights, shape, pose = np.split(values, (layout.joints, layout.joints + 3 * layout.shapes), axis=1)
        self._carry(weights, rows)
        shape = self.betas.numpy() @ shape.reshape(len(new), layout.shapes, 3)
        offsets = np.concatenate([shape, pose], axis=1) / np.repeat(self.step, 3)
        self.offsets[self.row_count : rows] = in_chunks(np.rint(offsets), self.offset_chunks)
        self.place[new] = np.arange(self.row_count, rows, dtype=np.int32)
        self.corners[self.leaf_count : leaves] = self.place[nodes]
        self.child[cells] = -2 - np.arange(self.leaf_count, leaves, dtype=np.int32)
        self.row_count, self.leaf_count = rows, leaves

    def arrays(self) -> tuple[np.ndarray, ...]:
        """What kernels read and write; others than before where they had to have more room."""
        return self.corners, self.asked, self.begins, self.carriers, self.weights, self.offsets, self.maps

    def _carry(self, weights: Float[np.ndarray, "n J"], rows: int) -> None:
        """Append W~ of new rows, up to `rows` of them, without the zeros but for those that fill the last SUMS."""
        carried = weights != 0
        counts = carried.sum(1)
        filled = SUMS * -(-counts // SUMS)
        self.begins = _with_room(self.begins, rows + 1)
        first = int(self.begins[self.row_count])
        ends = first + np.cumsum(filled)
        self.begins[self.row_count + 1 : rows + 1] = ends
        last = first + int(filled.sum())
        self.carriers, self.weights = _with_room(self.carriers, last), _with_room(self.weights, last)
        self.carriers[first:last], self.weights[first:last] = 0, 0
        row, joint = np.nonzero(carried)
        to_spare = (ends - filled) - (np.cumsum(counts) - counts)  # and what came before
        place = to_spare[row] + np.arange(len(row))
        self.carriers[place], self.weights[place] = joint, weights[row, joint]


def in_chunks(triples: Float[np.ndarray, "n C"], chunks: int) -> Float[np.ndarray, "n D"]:
    """x y z triples side by side, TRIPLES a chunk of LANES floats; zeros for what is to spare."""
    count, used = len(triples), 3 * TRIPLES
    padded = np.zeros((count, chunks * used), np.float32)
    padded[:, : triples.shape[1]] = triples
    out = np.zeros((count, chunks, LANES), np.float32)
    out[:, :, :used] = padded.reshape(count, chunks, used)
    return out.reshape(count, chunks * LANES)


def _with_room(array: np.ndarray, count: int) -> np.ndarray:
    """The array itself where it has `count` rows, else a larger one that begins with it."""
    if count <= len(array):
        return array
    larger = _on_lines((max(count, len(array) + len(array) // 2), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def _on_lines(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An empty array that begins with a cache line, as its rows then do where they fill some."""
    size = int(np.prod(shape)) * dtype.itemsize
    room = np.empty(size + LINE, np.uint8)
    begin = -room.ctypes.data % LINE
    return room[begin : begin + size].view(dtype).reshape(shape)


class TablePoser(FramePoser):
    """By the table and a few kernels; float32 on the CPU."""

    def __init__(self, body: Body, fields: GridFields, betas: Float[Tensor, "K"], points: int):
        joints, self.nodes = len(body.parents), NodeRows(body, fields, betas)
        self.order = np.empty(points, np.int32)  # of the first garment along a Morton curve: neighbours share rows
        self.fresh = True
        self.rotations, self.translation = np.empty((joints, 3, 3), np.float32), np.empty((1, 3), np.float32)
        self.points, self.posed = np.empty((points, 3), np.float32), np.empty((points, 3), np.float32)
        self.leaf = np.empty(points, np.int32)
        # B~s counts once, and each pose direction as much as the pose says
        step = np.repeat(self.nodes.step, 3)
        pose_map = np.pad(np.repeat(body.pose_map.numpy(), 3, axis=1), ((0, 0), (3, 0))) * step
        self.factor_map = in_chunks(pose_map, self.nodes.offset_chunks)
        self.factor_rest = in_chunks(step[None, :3], self.nodes.offset_chunks)[0]
        self.factors = self.factor_rest.copy()
        self.transforms = np.zeros((joints, LANES), np.float32)
        local = shared_array(np.empty((points, 3), np.float32), wp.vec3)
        leaf = shared_array(self.leaf, wp.int32)
        order, X = shared_array(self.order, wp.int32), shared_array(self.points, wp.vec3)
        transforms = shared_array(self.transforms, wp.float32, 2)
        self._skeleton = Recorded(
            joint_transforms,
            1,
            shared_array(np.array(body.parents, np.int32), wp.int32),
            shared_array(np.ascontiguousarray(body.joints(betas).numpy()), wp.vec3),
            shared_array(self.rotations, wp.mat33),
            shared_array(self.translation, wp.vec3),
            shared_array(np.empty((joints, 3, 3), np.float32), wp.mat33),
            shared_array(np.empty((joints, 3), np.float32), wp.vec3),
            transforms,
        )
        grid = fields.grid.compact
        low, shape = wp.vec3(*(float(x) for x in grid.low)), wp.vec3i(*grid.shape)
        child = shared_array(self.nodes.child, wp.int32)
        groups = -(-points // SOME)
        self._leaves = Recorded(find_leaves, groups, order, X, low, grid.root_size, shape, child, leaf, local)
        self.frame = np.zeros(1, np.int32)  # how many there were, this one among them
        self._pose_inputs = shared_array(self.frame, wp.int32), transforms, shared_array(self.factors, wp.float32)
        self._point_inputs = order, X, local, leaf, shared_array(self.posed, wp.vec3)
        self._record()

    def __call__(
        self, X: Float[Tensor, "N 3"], rotations: Float[Tensor, "J 3 3"], translation: Float[Tensor, "3"]
    ) -> Float[Tensor, "N 3"]:
        points = X.numpy()
        if len(points) != len(self.points):
            raise ValueError(f"this poser was made for {len(self.points)} points, but got {len(points)}: make another")
        if not np.isfinite(points).all():
            raise ValueError(
                f"{int((~np.isfinite(points)).any(1).sum())} of the garment's canonical vertices are NaN or infinite; "
                "mend the mesh before posing it"
            )
        self.points[:] = points
        if self.fresh:
            self.order[:], self.fresh = morton_order(self.points), False
        self.rotations[:], self.translation[0] = rotations.numpy(), translation.numpy()
        feature = (self.rotations[1:] - np.eye(3, dtype=np.float32)).reshape(-1)
        np.add(feature @ self.factor_map, self.factor_rest, out=self.factors)
        self._skeleton()
        self._leaves()
        if self.leaf.min(initial=0) < 0:
            self._learn()
        self.frame += 1
        self._mark()
        self._blend()
        self._pose()
        return torch.from_numpy(self.posed.copy())

    def _learn(self) -> None:
        """Read the rows that this frame is the first to need."""
        unknown = self.leaf < 0
        cells = -1 - self.leaf[unknown]
        before = self.nodes.arrays()
        self.nodes.add(np.unique(cells))
        self.leaf[unknown] = -2 - self.nodes.child[cells]
        if any(now is not then for now, then in zip(self.nodes.arrays(), before, strict=True)):  # for more room
            self._record()

    def _record(self) -> None:
        """The launches that read rows, on the arrays as they are."""
        nodes, count = self.nodes, len(self.leaf)
        frame, transforms, factors = self._pose_inputs
        order, X, local, leaf, posed = self._point_inputs
        corners, asked = shared_array(nodes.corners, wp.int32, 2), shared_array(nodes.asked, wp.int32)
        begins, carriers = shared_array(nodes.begins, wp.int32), shared_array(nodes.carriers, wp.uint16)
        weights, offsets = shared_array(nodes.weights, wp.float32), shared_array(nodes.offsets, wp.int16, 2)
        rows, maps = (begins, carriers, weights, offsets), shared_array(nodes.maps, wp.float32, 2)
        self._mark = Recorded(mark_rows, count, leaf, corners, frame, asked)
        self._blend = Recorded(blend_rows, 1, frame, asked, *rows, transforms, factors, maps)
        self._pose = Recorded(pose_points, count, order, X, local, leaf, corners, maps, posed)


def frame_poser(model: GarmentModel, betas: Float[Tensor, "K"], points: int) -> FramePoser:
    """The fastest way there is for a garment model."""
    if isinstance(model.fields, GridFields):
        return TablePoser(model.body, model.fields, betas, points)
    return ModelPoser(model, betas)
