"""The spine's picture: simulated, canonical and re-posed side by side, a row a frame."""

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from widgets.gl import CannotDraw
from widgets.picture import write_picture
from widgets.scene import Scene, View, dressed
from workbench.demo import DemoResult, DressedBody

log = logging.getLogger(__name__)

ROWS = 3
VIEW = (420, 560)  # pixels of one view: a body is higher than wide


def draw_demo(result: DemoResult, path: Path) -> Path:
    """Draw the demo's result into `path`; on a machine that cannot draw, say so and leave the picture out."""
    scene = demo_scene(result)
    rows = len(scene.views) // scene.columns
    try:
        return write_picture(path, scene, (VIEW[0] * scene.columns, VIEW[1] * rows))
    except CannotDraw as reason:
        log.warning("%s is left out: %s", path.name, reason)
        return path


def demo_scene(result: DemoResult, rows: int = ROWS) -> Scene:
    """Three columns (the simulation, the constant body, the new shape), one row a frame, spread over the motion."""
    frames = len(result.simulated.garment)
    views: list[View] = []
    for frame in sorted({round(step) for step in np.linspace(0, frames - 1, min(rows, frames) * 2 + 1)[1::2]}):
        for title, place in (
            ("simulated", result.simulated),
            ("canonical", result.canonical),
            ("another shape", result.reposed),
        ):
            views.append(_view(result, place, frame, f"{title}, frame {frame}"))
    return Scene(tuple(views), columns=3)


def _view(result: DemoResult, place: DressedBody, frame: int, title: str) -> View:
    body = place.body[min(frame, len(place.body) - 1)].numpy()
    inside = place.collisions.inside[frame].numpy()
    here = standing_place(body)  # the walk is taken out: all views share one camera
    counted = f"{title}: {int(inside.sum())} inside"
    return dressed(
        body - here,
        result.body_faces.numpy(),
        place.garment[frame].numpy() - here,
        result.garment_faces.numpy(),
        colliding=inside,
        title=counted,
    )


def standing_place(vertices: Float[ndarray, "V 3"]) -> Float[ndarray, "3"]:
    """Where the body stands: the middle of its outline, on the floor."""
    low, high = vertices.min(0), vertices.max(0)
    return np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.0], dtype=vertices.dtype)
