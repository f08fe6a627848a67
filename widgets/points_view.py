"""Clouds to look at: surfels (discs along the normals), coloured by normal, as many as the density slider says.

Objects: scans (ScanSequence, ScanFrame, a Scan of a file), clouds of the model (ClothedPoints), and TrainedPoints
itself, which is asked anew for as many points as the slider says.
"""

from typing import Any

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.colors import ListedColormap
from numpy import ndarray
from scipy.spatial import KDTree

from widgets.controls import Choice, Control, Group, Number, frame_slider
from widgets.panel import Panel
from widgets.scene import Points, Scalars, Scene, View
from workbench.body.model import Body
from workbench.formats.scans import Scan
from workbench.points.clothed_points import ClothedPoints
from workbench.points.dressing import Dresser
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.trained_points import TrainedPoints
from workbench.points.uv_position_map import PosedBodies, posed_bodies, scattered_queries

COLOURS = 256  # directions that have a colour of their own: a colour map has no more steps
COLOUR_MAP = "normals"
COVER = 6.0  # discs cover the surface so often, that no gap is seen where points lie unevenly
AREA = 2.2  # square metres of a clothed person
FIRST = 10_000  # points at the start, where there are so many
FEWEST, STEP = 500, 500
MOST = 60_000  # that a model is asked for


def directions(count: int) -> Float[ndarray, "K 3"]:
    """Unit vectors spread evenly, from up to down: a spiral that turns by the golden angle."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)


PALETTE = directions(COLOURS)
matplotlib.colormaps.register(ListedColormap((PALETTE[:, [0, 2, 1]] * (1, 1, -1) + 1) / 2), name=COLOUR_MAP, force=True)


def normal_colours(normals: Float[ndarray, "N 3"]) -> Scalars:
    """Right, up and towards the front as red, green and blue, of the nearest of 256 directions."""
    nearest = np.asarray(KDTree(PALETTE).query(normals)[1])
    return Scalars(
        nearest.astype(np.float32),
        "normal, up to down",
        limits=(0.0, COLOURS - 1.0),
        colour_map=COLOUR_MAP,
        legend=False,
    )


def surfels(points: Float[ndarray, "N 3"], normals: Float[ndarray, "N 3"], name: str = "surfels") -> Points:
    """Discs that touch: fewer ones are larger."""
    radius = float(np.sqrt(COVER * AREA / (np.pi * max(1, len(points)))))
    return Points(points, normals=normals, radius=radius, scalars=normal_colours(normals), name=name)


def cloud_of(cloud: ScanFrame | Scan | ClothedPoints, title: str = "", count: int | None = None) -> View:
    """A view of a cloud, or of `count` of its points.  ValueError for more than there are.

    Scans come in no order; the points of a model come row by row of the atlas: they are taken evenly.
    """
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    if points.ndim == 3:
        points, normals = points[0], normals[0]
    if count is not None and not 1 <= count <= len(points):
        raise ValueError(f"{count} points are asked for of a cloud of {len(points)}; expected 1 to {len(points)}")
    kept = np.linspace(0, len(points) - 1, count or len(points)).round().astype(np.int64)
    return View((surfels(points[kept], normals[kept]),), title)


def cloud_view(cloud: ScanFrame | Scan | ClothedPoints, *, title: str = "") -> Panel:
    """One cloud with its density."""
    density = density_slider(np.asarray(cloud.points).shape[-2])
    return Panel(
        (Group("Points", (density,)),),
        lambda: Scene((cloud_of(cloud, title, density.value),)),
        lambda: f"{density.value:,} points",
        title="A cloud",
    )


def scans_view(sequence: ScanSequence, *, frame: int = 0) -> Panel:
    """The scans of a sequence, one after another, with their density."""
    density, shown = density_slider(sequence.ticks.shape[1]), frame_slider(len(sequence), frame)
    controls: tuple[Control, ...] = (shown, density) if len(sequence) > 1 else (density,)
    return Panel(
        (Group("Scan", controls),),
        lambda: Scene((cloud_of(sequence.frame(shown.value), f"{sequence.outfit}, {sequence.motion}", density.value),)),
        lambda: f"scan {shown.value} of {len(sequence)}: {density.value:,} of {sequence.ticks.shape[1]:,} points",
        title="Scans",
    )


def trained_points_view(
    trained: TrainedPoints, bodies: PosedBodies | None = None, *, outfit: str | None = None, body: Body | None = None
) -> Panel:
    """An outfit of the model on one body (at rest unless given), asked at as many places of the skin as are wanted."""
    body = Body.default() if body is None else body
    if bodies is None:
        bodies = posed_bodies(body, body.rest_rotations()[None], body.mean_shape())
    which = Choice("outfit", trained.outfits, outfit)
    density = Number("points", FIRST, FEWEST, MOST, STEP, "as many places of the body as clothes are asked for")

    def scene() -> Scene:
        with torch.no_grad():
            geometry = trained.model.geometry(torch.tensor([trained.number_of(which.value)]))
        queries = scattered_queries(body, int(density.value), np.random.default_rng(0))
        return Scene((cloud_of(Dresser(trained.model, geometry, body, queries=queries)(bodies), which.value),))

    return Panel(
        (Group("Clothes", (which, density)),),
        scene,
        lambda: f"{which.value}: {density.value:,} points",
        title="POP",
    )


def density_slider(most: int) -> Number:
    """How many of the points are seen; each grows as they become fewer."""
    options: dict[str, Any] = {"told": "discs grow as they become fewer"}
    return Number("points", min(FIRST, most), min(FEWEST, most), most, 1, **options)
