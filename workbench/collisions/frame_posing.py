"""Eq. 7-8, frame by frame, for one shape.  canonical X (N,3), theta (J,3,3), H (3) -> posed garment (N,3).

`TablePoser` computes what `GarmentModel` computes with `GridFields`, in a tenth of the time: a node's B~s is contracted
with beta once, when the first garment reaches the node, into a compact copy of the rows that this garment needs; then
one kernel finds a point's cell, reads its eight rows, blends, corrects and skins.
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.posing_kernels import LANES, TRIPLES, find_leaves, joint_transforms, pose_points
from workbench.geometry.field_grid import shared_array

ROWS_INPUT = 3  # of `pose_points`: corners, then rows


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
    """The rows of those nodes of the table that were asked for, B~s contracted with beta, in whole chunks.

    Grows by need; it never holds more rows than the table has nodes.
    """

    def __init__(self, fields: GridFields, betas: Float[Tensor, "K"]):
        self.fields, self.betas = fields, betas
        layout = fields.layout
        self.weight_chunks = -(-layout.joints // LANES)
        self.offset_chunks = -(-(1 + layout.poses) // TRIPLES)
        self.child = fields.grid.child.numpy().copy()  # of a leaf: -1, or -2 - its number here
        self.place = np.full(len(fields.grid.values), -1, np.int32)  # of a node's row here
        self.rows = np.empty((0, LANES * (self.weight_chunks + self.offset_chunks)), np.float32)
        self.corners = np.empty((0, 8), np.int32)  # rows of a numbered leaf
        self.row_count = self.leaf_count = 0

    def add(self, cells: Int[np.ndarray, "c"]) -> None:
        """Number the leaf cells and read the rows of their corners."""
        nodes = self.fields.grid.corner.numpy()[cells]
        new = np.unique(nodes[self.place[nodes] < 0])
        rows, leaves = self.row_count + len(new), self.leaf_count + len(cells)
        self.rows, self.corners = _with_room(self.rows, rows), _with_room(self.corners, leaves)
        self.rows[self.row_count : rows] = self._read(new)
        self.place[new] = np.arange(self.row_count, rows, dtype=np.int32)
        self.corners[self.leaf_count : leaves] = self.place[nodes]
        self.child[cells] = -2 - np.arange(self.leaf_count, leaves, dtype=np.int32)
        self.row_count, self.leaf_count = rows, leaves

    def _read(self, nodes: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n C"]:
        values = self.fields.layout.split(self.fields.grid.values[torch.from_numpy(nodes).long()])
        rows = np.zeros((len(nodes), self.rows.shape[1]), np.float32)
        rows[:, : self.fields.layout.joints] = values.weights.numpy()
        shape = torch.einsum("k,nki->ni", self.betas, values.shape_directions)
        offsets = torch.cat([shape[:, None], values.pose_directions], dim=1).flatten(1)
        rows[:, LANES * self.weight_chunks :] = in_chunks(offsets.numpy(), self.offset_chunks)
        return rows


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
    larger = np.empty((max(count, len(array) + len(array) // 2), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


class TablePoser(FramePoser):
    """By the table and one kernel; float32 on the CPU."""

    def __init__(self, body: Body, fields: GridFields, betas: Float[Tensor, "K"], points: int):
        joints = len(body.parents)
        self.nodes = NodeRows(fields, betas)
        self.rotations = np.empty((joints, 3, 3), np.float32)
        self.translation = np.empty((1, 3), np.float32)
        self.points, self.posed = np.empty((points, 3), np.float32), np.empty((points, 3), np.float32)
        self.unknown, self.unknown_count = np.empty(points, np.int32), np.zeros(1, np.int32)
        # B~s counts once, and each pose direction as much as the pose says
        pose_map = np.repeat(body.pose_map.numpy(), 3, axis=1)
        self.factor_map = in_chunks(np.pad(pose_map, ((0, 0), (3, 0))), self.nodes.offset_chunks)
        self.factor_rest = in_chunks(np.ones((1, 3), np.float32), self.nodes.offset_chunks)[0]
        self.factors = self.factor_rest.copy()
        self.transforms = np.zeros((LANES * self.nodes.weight_chunks, LANES), np.float32)
        local, leaf = np.empty((points, 3), np.float32), np.empty(points, np.int32)
        rest = np.ascontiguousarray(body.joints(betas).numpy())
        self._skeleton = Recorded(
            joint_transforms,
            1,
            shared_array(np.array(body.parents, np.int32), wp.int32),
            shared_array(rest, wp.vec3),
            shared_array(self.rotations, wp.mat33),
            shared_array(self.translation, wp.vec3),
            shared_array(np.empty((joints, 3, 3), np.float32), wp.mat33),
            shared_array(np.empty((joints, 3), np.float32), wp.vec3),
            shared_array(self.transforms, wp.float32, 2),
        )
        grid = fields.grid.compact
        shared_points, shared_leaf, shared_local = (
            shared_array(self.points, wp.vec3),
            shared_array(leaf, wp.int32),
            shared_array(local, wp.vec3),
        )
        self._leaves = Recorded(
            find_leaves,
            points,
            shared_points,
            wp.vec3(*(float(x) for x in grid.low)),
            grid.root_size,
            wp.vec3i(*grid.shape),
            shared_array(self.nodes.child, wp.int32),
            shared_leaf,
            shared_local,
            shared_array(self.unknown, wp.int32),
            shared_array(self.unknown_count, wp.int32),
        )
        self._pose = Recorded(
            pose_points,
            points,
            shared_points,
            shared_local,
            shared_leaf,
            *self._shared_rows(),
            self.nodes.weight_chunks,
            self.nodes.offset_chunks,
            shared_array(self.transforms, wp.float32, 2),
            shared_array(self.factors, wp.float32),
            shared_array(self.posed, wp.vec3),
        )

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
        self.rotations[:], self.translation[0] = rotations.numpy(), translation.numpy()
        feature = (self.rotations[1:] - np.eye(3, dtype=np.float32)).reshape(-1)
        np.add(feature @ self.factor_map, self.factor_rest, out=self.factors)
        self._skeleton()
        self._leaves()
        if self.unknown_count[0]:
            self._learn()
        self._pose()
        return torch.from_numpy(self.posed.copy())

    def _learn(self) -> None:
        """Read the rows that this frame is the first to need."""
        self.nodes.add(np.unique(self.unknown[: self.unknown_count[0]]))
        self.unknown_count[0] = 0
        self._leaves()
        for index, array in enumerate(self._shared_rows()):
            self._pose.replace(ROWS_INPUT + index, array)

    def _shared_rows(self) -> tuple[wp.array, wp.array]:
        return shared_array(self.nodes.corners, wp.int32, 2), shared_array(self.nodes.rows, wp.float32, 2)


class Recorded:
    """A launch that is repeated: a fifth of the cost of a new one.  Keeps its arrays alive."""

    def __init__(self, kernel: Any, dim: int, *inputs: Any):
        self.inputs = list(inputs)
        self.command: Any = wp.launch(
            kernel, dim=dim, inputs=self.inputs, device="cpu", record_tape=False, record_cmd=True
        )

    def __call__(self) -> None:
        self.command.launch()

    def replace(self, index: int, array: wp.array) -> None:
        """Another array for one input."""
        self.inputs[index] = array
        self.command.set_param_at_index(index, array)


def frame_poser(model: GarmentModel, betas: Float[Tensor, "K"], points: int) -> FramePoser:
    """The fastest way there is for a garment model."""
    if isinstance(model.fields, GridFields):
        return TablePoser(model.body, model.fields, betas, points)
    return ModelPoser(model, betas)
