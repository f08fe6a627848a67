"""What is to be looked at, without saying how: layers of arrays in linked views.  No engine is imported here.

A Scene is drawn by widgets.picture (PNG, through pyvista); other engines read the same arrays.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

Colour = tuple[float, float, float]  # red, green, blue in [0, 1], as a screen shows them

SKIN: Colour = (0.86, 0.72, 0.62)
CLOTH: Colour = (0.36, 0.52, 0.72)
WARNING: Colour = (0.95, 0.0, 0.45)  # colliding vertices: a colour that no colour map and no cloth has
ROOM, ROOM_FOR_TITLES = 1.06, 1.16  # size of a view against what is in it
PAPER: Colour = (0.97, 0.97, 0.96)


@dataclass(frozen=True)
class Scalars:
    """One number a vertex, shown by colour; `limits` are the numbers at both ends of the colour map."""

    values: Float[ndarray, "N"]
    name: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    colour_map: str = "viridis"

    def range(self) -> tuple[float, float]:
        """`limits`, or the smallest and largest finite value."""
        if self.limits is not None:
            return self.limits
        finite = self.values[np.isfinite(self.values)]
        return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)


@dataclass(frozen=True)
class Mesh:
    """A surface, metres."""

    vertices: Float[ndarray, "N 3"]
    faces: Int[ndarray, "F 3"]
    colour: Colour = CLOTH
    opacity: float = 1.0
    scalars: Scalars | None = None
    smooth: bool = True
    edges: bool = False
    name: str = ""


@dataclass(frozen=True)
class Points:
    """Round dots of `size` pixels; `on_top` shows them through whatever lies in front."""

    positions: Float[ndarray, "N 3"]
    colour: Colour = WARNING
    size: float = 6.0
    scalars: Scalars | None = None
    on_top: bool = False
    name: str = ""


@dataclass(frozen=True)
class Arrows:
    """One arrow from each start, as long as its vector (metres)."""

    starts: Float[ndarray, "N 3"]
    vectors: Float[ndarray, "N 3"]
    colour: Colour = (0.1, 0.1, 0.1)
    name: str = ""


Layer = Mesh | Points | Arrows


@dataclass(frozen=True)
class Camera:
    """Where it is looked from and at, metres; `view_angle` is the vertical opening in degrees."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    view_angle: float = 24.0


@dataclass(frozen=True)
class View:
    """Layers seen together; `camera` None takes the scene's."""

    layers: tuple[Layer, ...]
    title: str = ""
    camera: Camera | None = None


@dataclass(frozen=True)
class Scene:
    """Views side by side that share one camera, so that they can be compared; `columns` 0 puts all in one row."""

    views: tuple[View, ...]
    camera: Camera | None = None  # None: all of it, from the front
    columns: int = 0
    background: Colour = PAPER

    def resolved_camera(self, aspect: float = 1.0) -> Camera:
        """The shared camera; `aspect` is a view's width over its height."""
        if self.camera is not None:
            return self.camera
        titled = any(view.title for view in self.views)
        layers = [layer for view in self.views for layer in view.layers]
        return camera_of(layers, margin=ROOM_FOR_TITLES if titled else ROOM, aspect=aspect)


def positions_of(layer: Layer) -> Float[ndarray, "N 3"]:
    """The points that a layer covers."""
    if isinstance(layer, Mesh):
        return layer.vertices
    if isinstance(layer, Points):
        return layer.positions
    return np.concatenate([layer.starts, layer.starts + layer.vectors])


def camera_of(
    layers: Iterable[Layer],
    direction: tuple[float, float, float] = (0.25, -1.0, 0.12),
    view_angle: float = 24.0,
    margin: float = ROOM,
    aspect: float = 1.0,
) -> Camera:
    """A camera that sees all layers from `direction` (the front, slightly left and above: the body faces -y).

    `aspect` is the view's width over its height.  Raises ValueError when there is nothing to see.
    """
    points = [positions_of(layer) for layer in layers]
    points = np.concatenate(points) if points else np.zeros((0, 3))
    points = points[np.isfinite(points).all(1)]
    if len(points) == 0:
        raise ValueError("there is nothing to look at: the scene has no finite point")
    towards = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    axes = np.stack([right, np.cross(towards, right), towards])
    seen = points @ axes.T
    middle = (seen.min(0) + seen.max(0)) / 2
    seen = seen - middle
    slope = np.tan(np.radians(view_angle) / 2)
    # a point at depth d in front of the middle needs the camera d further away
    needed = np.maximum(np.abs(seen[:, 1]), np.abs(seen[:, 0]) / aspect) * margin / slope + seen[:, 2]
    target = middle @ axes
    position = target + towards * max(float(needed.max()), 1e-3)
    return Camera(_triple(position), _triple(target), _up(towards), view_angle)


def dressed(
    body: Float[ndarray, "V 3"],
    body_faces: Int[ndarray, "G 3"],
    garment: Float[ndarray, "N 3"],
    garment_faces: Int[ndarray, "F 3"],
    colliding: Bool[ndarray, "N"] | None = None,
    title: str = "",
) -> View:
    """A body in a garment; colliding vertices, which the body would hide, are drawn on top."""
    layers: tuple[Layer, ...] = (
        Mesh(body, body_faces, SKIN, name="body"),
        Mesh(garment, garment_faces, CLOTH, name="garment"),
    )
    if colliding is not None and colliding.any():
        layers += (Points(garment[colliding], WARNING, on_top=True, name="colliding"),)
    return View(layers, title)


def ghosted(view: View, opacity: float = 0.35) -> View:
    """The same view with see-through surfaces."""
    return replace(view, layers=tuple(replace(x, opacity=opacity) if isinstance(x, Mesh) else x for x in view.layers))


def _up(towards: ndarray) -> tuple[float, float, float]:
    return (0.0, 0.0, 1.0) if abs(towards[2]) < 0.99 else (0.0, 1.0, 0.0)


def _triple(vector: ndarray) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
