"""A flat cut through space, as a mesh to be coloured, and the line on it where a quantity passes a level."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from widgets.controls import Choice, Group, Number
from widgets.scene import Camera, Mesh, Points, Scalars, camera_of

ACROSS = {"from the front (x, z)": 1, "from the side (y, z)": 0, "from above (x, y)": 2}
TOWARDS = {0: (1.0, -0.35, 0.15), 1: (0.25, -1.0, 0.12), 2: (0.15, -0.8, 1.0)}  # from where a cut is looked at
MARGIN = 0.12  # metres around the body that a cut reaches


@dataclass(frozen=True, eq=False)
class SlicePlane:
    """Points on a regular net across one axis, row by row."""

    points: Float[ndarray, "N 3"]
    faces: Int[ndarray, "F 3"]
    shape: tuple[int, int]

    @staticmethod
    def of(
        low: Float[ndarray, "3"], high: Float[ndarray, "3"], axis: int, position: float, across: int
    ) -> "SlicePlane":
        """The cut at `position` (metres) along `axis` of a box; `across` points on its longer side."""
        first, second = (other for other in range(3) if other != axis)
        size = high - low
        step = max(size[first], size[second]) / (across - 1)
        lines = [np.arange(low[other], high[other] + step / 2, step) for other in (first, second)]
        points = np.empty((len(lines[1]), len(lines[0]), 3), np.float32)
        points[..., axis] = position
        points[..., first], points[..., second] = np.meshgrid(*lines)
        rows, columns = points.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        return SlicePlane(points.reshape(-1, 3), faces, (rows, columns))

    def coloured(self, scalars: Scalars, name: str = "cut") -> Mesh:
        """The cut with a number at each of its points."""
        return Mesh(self.points, self.faces, scalars=scalars, name=name, smooth=False)

    def level_line(self, values: Float[ndarray, "N"], level: float = 0.0, name: str = "level") -> Points:
        """Dots where the quantity passes the level between neighbouring points of the net."""
        rows, columns = self.shape
        index = np.arange(rows * columns).reshape(rows, columns)
        pairs = np.concatenate(
            [
                np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
                np.stack([index[:-1].ravel(), index[1:].ravel()], 1),
            ]
        )
        a, b = values[pairs[:, 0]] - level, values[pairs[:, 1]] - level
        passes = (a < 0) != (b < 0)
        t = (a[passes] / (a[passes] - b[passes]))[:, None]
        ends = self.points[pairs[passes]]
        dots = ((1 - t) * ends[:, 0] + t * ends[:, 1]).astype(np.float32)
        return Points(dots, (0.05, 0.05, 0.05), size=3.0, name=name, on_top=True)


@dataclass(frozen=True, eq=False)
class SliceControls:
    """Which way a box is cut, and where."""

    low: Float[ndarray, "3"]
    high: Float[ndarray, "3"]
    direction: Choice
    place: Number

    @staticmethod
    def around(vertices: Float[Tensor, "V 3"], place: float = 0.5) -> "SliceControls":
        """For cuts through a body; `place` is where between both ends (0, 1) the first cut lies."""
        low, high = vertices.amin(0).numpy() - MARGIN, vertices.amax(0).numpy() + MARGIN
        where = Number("place of the cut", place, 0.0, 1.0, 0.01, "0 and 1 are the two ends of the box")
        return SliceControls(low, high, Choice("cut seen", tuple(ACROSS)), where)

    @property
    def group(self) -> Group:
        return Group("Cut through space", (self.direction, self.place))

    @property
    def axis(self) -> int:
        return ACROSS[self.direction.value]

    @property
    def position(self) -> float:
        """Metres along the axis."""
        return float(self.low[self.axis] + self.place.value * (self.high[self.axis] - self.low[self.axis]))

    def plane(self, across: int) -> SlicePlane:
        return SlicePlane.of(self.low, self.high, self.axis, self.position, across)

    def camera(self, aspect: float) -> Camera:
        """Looks at the whole box, rather from the side that the cut shows."""
        corners = np.stack([self.low, self.high])
        box = np.stack(np.meshgrid(*corners.T), -1).reshape(-1, 3)
        return camera_of([Points(box)], TOWARDS[self.axis], aspect=aspect)


def tensor_of(plane: SlicePlane) -> Float[Tensor, "N 3"]:
    """The points of a cut, for a field."""
    return torch.from_numpy(plane.points)
