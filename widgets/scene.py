"""What is to be looked at, without saying how: layers of arrays over time, in linked views.  No engine is imported.

A Scene has three faces: widgets.live (a notebook's browser), widgets.picture (PNG) and widgets.page (one HTML file).
An array with a leading axis T moves; one without it stands still.  All moving arrays of a scene have the same T.
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


@dataclass(frozen=True, eq=False)
class Scalars:
    """One number a vertex, shown by colour; `limits` are the numbers at both ends of the colour map.

    Values below `threshold` are marked: drawn in the warning colour, through whatever lies in front.
    With `categories`, values are whole numbers that index them, and the legend names them.  Without `legend`, colours
    speak for themselves and no bar of numbers is drawn.
    """

    values: Float[ndarray, "*T N"]
    name: str
    unit: str = ""
    limits: tuple[float, float] | None = None
    colour_map: str = "viridis"
    threshold: float | None = None
    categories: tuple[str, ...] = ()
    legend: bool = True

    def __post_init__(self) -> None:
        finite = self.values[np.isfinite(self.values)]
        if self.categories and len(finite) and not (finite.min() >= 0 and finite.max() < len(self.categories)):
            raise ValueError(
                f"{self.name!r} has categories {finite.min():g} to {finite.max():g}, but names for 0 to "
                f"{len(self.categories) - 1}"
            )

    def range(self) -> tuple[float, float]:
        """`limits`, or the smallest and largest finite value."""
        if self.categories:
            return (-0.5, len(self.categories) - 0.5)
        if self.limits is not None:
            return self.limits
        finite = self.values[np.isfinite(self.values)]
        return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


@dataclass(frozen=True, eq=False)
class Regions:
    """A named region for each vertex, which a viewer can isolate; -1 is no region."""

    labels: Int[ndarray, "N"]
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface, metres.  `marked` vertices are drawn through whatever lies in front, and `mark_name` says what they
    are; `choices` are further numbers that a browser can show in place of `scalars`."""

    vertices: Float[ndarray, "*T N 3"]
    faces: Int[ndarray, "F 3"]
    colour: Colour = CLOTH
    opacity: float = 1.0
    scalars: Scalars | None = None
    smooth: bool = True
    edges: bool = False
    name: str = ""
    marked: Bool[ndarray, "*S M"] | None = None
    mark_name: str = "inside the body"
    choices: tuple[Scalars, ...] = ()
    regions: Regions | None = None

    def __post_init__(self) -> None:
        _check_per_vertex(self, self.vertices.shape[-2])
        if len(self.faces) and not 0 <= self.faces.min() <= self.faces.max() < self.vertices.shape[-2]:
            raise ValueError(
                f"{self.name or 'mesh'}: faces index vertices {self.faces.min()} to {self.faces.max()}, but the mesh "
                f"has {self.vertices.shape[-2]} vertices"
            )


@dataclass(frozen=True, eq=False)
class Points:
    """Round dots of `size` pixels; `on_top` shows them through whatever lies in front.

    With `normals` they are surfels: discs of `radius` metres that face along them.
    """

    positions: Float[ndarray, "*T N 3"]
    colour: Colour = WARNING
    size: float = 6.0
    scalars: Scalars | None = None
    on_top: bool = False
    name: str = ""
    normals: Float[ndarray, "*S M 3"] | None = None
    radius: float = 0.006
    marked: Bool[ndarray, "*S M"] | None = None
    mark_name: str = "marked"
    choices: tuple[Scalars, ...] = ()

    def __post_init__(self) -> None:
        _check_per_vertex(self, self.positions.shape[-2])
        if self.normals is not None and self.normals.shape[-2] != self.positions.shape[-2]:
            raise ValueError(
                f"{self.name or 'points'}: {self.normals.shape[-2]} normals, but {self.positions.shape[-2]} points"
            )


@dataclass(frozen=True, eq=False)
class Arrows:
    """One arrow from each start, as long as its vector (metres)."""

    starts: Float[ndarray, "*T N 3"]
    vectors: Float[ndarray, "*T N 3"]
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


@dataclass(frozen=True, eq=False)
class View:
    """Layers seen together; `camera` None takes the scene's, and then turns with all others."""

    layers: tuple[Layer, ...]
    title: str = ""
    camera: Camera | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Views side by side that share one camera, so that they can be compared; `columns` 0 puts all in one row."""

    views: tuple[View, ...]
    camera: Camera | None = None  # None: all of it, from the front
    columns: int = 0
    background: Colour = PAPER
    fps: float = 30.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps must be a number above 0, but got {self.fps}")
        lengths = self._lengths()
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name}: {frames}" for name, frames in lengths.items())
            raise ValueError(f"frame counts differ ({told}); cut all to one length")

    @property
    def frames(self) -> int:
        """T; 1 when nothing moves."""
        return max(self._lengths().values(), default=1)

    def at(self, frame: int) -> "Scene":
        """One frame, without time: marked vertices become points on top.

        Raises ValueError for a frame that is not there; negative ones count from the end.
        """
        if not -self.frames <= frame < self.frames:
            raise ValueError(f"there is no frame {frame}; the scene has frames 0 to {self.frames - 1}")
        return replace(self, views=tuple(replace(v, layers=_still(v.layers, frame)) for v in self.views))

    def resolved_camera(self, aspect: float = 1.0) -> Camera:
        """The shared camera; `aspect` is a view's width over its height."""
        if self.camera is not None:
            return self.camera
        titled = any(view.title for view in self.views)
        layers = [layer for view in self.views for layer in view.layers]
        return camera_of(layers, margin=ROOM_FOR_TITLES if titled else ROOM, aspect=aspect)

    def _lengths(self) -> dict[str, int]:
        """Frames of everything that moves, by what it is."""
        lengths: dict[str, int] = {}
        for index, view in enumerate(self.views):
            for layer in view.layers:
                for what, array, still in _arrays(layer):
                    if array.ndim > still:
                        lengths[f"{view.title or f'view {index}'}, {layer.name or 'layer'}, {what}"] = len(array)
        return lengths


def positions_of(layer: Layer) -> Float[ndarray, "N 3"]:
    """The points that a layer covers, in all its frames."""
    if isinstance(layer, Mesh):
        return layer.vertices.reshape(-1, 3)
    if isinstance(layer, Points):
        return layer.positions.reshape(-1, 3)
    return np.concatenate([layer.starts.reshape(-1, 3), (layer.starts + layer.vectors).reshape(-1, 3)])


def marks_of(layer: Mesh | Points) -> Bool[ndarray, "*T N"] | None:
    """Which vertices are marked: by `marked`, or by a value below its threshold; None where nothing can be."""
    scalars = layer.scalars
    below = None if scalars is None or scalars.threshold is None else scalars.values < scalars.threshold
    if below is None or layer.marked is None:
        return layer.marked if below is None else below
    return layer.marked | below


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
    body: Float[ndarray, "*T V 3"],
    body_faces: Int[ndarray, "G 3"],
    garment: Float[ndarray, "*T N 3"],
    garment_faces: Int[ndarray, "F 3"],
    colliding: Bool[ndarray, "*T N"] | None = None,
    title: str = "",
) -> View:
    """A body in a garment; colliding vertices, which the body would hide, are seen through it."""
    return View(
        (
            Mesh(body, body_faces, SKIN, name="body"),
            Mesh(garment, garment_faces, CLOTH, name="garment", marked=colliding),
        ),
        title,
    )


def ghosted(view: View, opacity: float = 0.35) -> View:
    """The same view with see-through surfaces."""
    return replace(view, layers=tuple(replace(x, opacity=opacity) if isinstance(x, Mesh) else x for x in view.layers))


def _arrays(layer: Layer) -> list[tuple[str, ndarray, int]]:
    """Every array of a layer that may move: what it is, the array, its number of axes when it stands still."""
    if isinstance(layer, Arrows):
        return [("arrows", layer.starts, 2)]
    arrays = [("positions", layer.vertices if isinstance(layer, Mesh) else layer.positions, 2)]
    if layer.marked is not None:
        arrays.append(("marks", layer.marked, 1))
    if isinstance(layer, Points) and layer.normals is not None:
        arrays.append(("normals", layer.normals, 2))
    shown = () if layer.scalars is None else (layer.scalars,)
    return arrays + [(scalars.name, scalars.values, 1) for scalars in shown + layer.choices]


def _still(layers: tuple[Layer, ...], frame: int) -> tuple[Layer, ...]:
    """The layers of one frame, and their marked vertices on top."""
    still: list[Layer] = []
    on_top: list[Layer] = []
    for layer in layers:
        if isinstance(layer, Arrows):
            still.append(replace(layer, starts=_pick(layer.starts, 2, frame), vectors=_pick(layer.vectors, 2, frame)))
            continue
        marks, scalars = marks_of(layer), layer.scalars
        values = None if scalars is None else replace(scalars, values=_pick(scalars.values, 1, frame), threshold=None)
        if isinstance(layer, Mesh):
            positions = _pick(layer.vertices, 2, frame)
            still.append(replace(layer, vertices=positions, scalars=values, marked=None, choices=()))
        else:
            positions = _pick(layer.positions, 2, frame)
            normals = None if layer.normals is None else _pick(layer.normals, 2, frame)
            still.append(replace(layer, positions=positions, scalars=values, normals=normals, marked=None, choices=()))
        marked = positions[_pick(marks, 1, frame)] if marks is not None else positions[:0]
        if len(marked):
            on_top.append(Points(marked, WARNING, on_top=True, name=f"marked on {layer.name}"))
    return tuple(still + on_top)


def _pick(array: ndarray, still: int, frame: int) -> ndarray:
    return array[frame] if array.ndim > still else array


def _check_per_vertex(layer: "Mesh | Points", count: int) -> None:
    """Everything that is given a vertex is there for every vertex."""
    shown = () if layer.scalars is None else (layer.scalars,)
    given = [(scalars.name, scalars.values) for scalars in shown + layer.choices]
    if layer.marked is not None:
        given.append(("marked", layer.marked))
    if isinstance(layer, Mesh) and layer.regions is not None:
        given.append(("regions", layer.regions.labels))
    for what, array in given:
        if array.shape[-1] != count:
            raise ValueError(f"{layer.name or 'layer'}: {what} has {array.shape[-1]} values, but {count} vertices")


def _up(towards: ndarray) -> tuple[float, float, float]:
    return (0.0, 0.0, 1.0) if abs(towards[2]) < 0.99 else (0.0, 1.0, 0.0)


def _triple(vector: ndarray) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
