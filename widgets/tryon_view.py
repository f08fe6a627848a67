"""`workbench demo`'s picture and page: the dressed body in motion, and the canonical garment it comes from."""

import logging
from pathlib import Path

import numpy as np

from widgets.demo_picture import standing_place
from widgets.frontend_bundle import NotBundled
from widgets.gl import CannotDraw
from widgets.page import write_page
from widgets.picture import write_picture
from widgets.scene import CLOTH, SKIN, Mesh, Scene, View, dressed
from workbench.tryon_demo import TryOnDemo

log = logging.getLogger(__name__)

COLUMNS = 4  # frames in the picture
VIEW = (380, 560)  # pixels of one view: a body is higher than wide


def draw_tryon(demo: TryOnDemo, path: Path) -> Path:
    """Frames of the motion over the canonical garments they come from; left out where a machine cannot draw."""
    scene = strip(demo)
    try:
        return write_picture(path, scene, (VIEW[0] * scene.columns, 2 * VIEW[1]))
    except CannotDraw as reason:
        log.warning("%s is left out: %s", path.name, reason)
        return path


def write_tryon_page(demo: TryOnDemo, path: Path) -> Path:
    """The motion as one offline HTML file; left out where the viewer was not bundled."""
    share = 100 * demo.posed.share
    try:
        return write_page(path, moving(demo), f"Try-on: {len(demo.result.garment)} frames, {share:.3f} % inside")
    except NotBundled as reason:
        log.warning("%s is left out: %s", path.name, reason)
        return path


def strip(demo: TryOnDemo, columns: int = COLUMNS) -> Scene:
    """The first row posed, the second canonical; colliding vertices are drawn on top."""
    result, T = demo.result, len(demo.result.garment)
    frames = sorted({round(step) for step in np.linspace(0, T - 1, min(columns, T) * 2 + 1)[1::2]})
    above, below = [], []
    for frame in frames:
        body = result.body[frame].numpy()
        here = standing_place(body)
        inside, within = demo.posed.inside[frame].numpy(), demo.canonical.inside[frame].numpy()
        faces = result.body_faces.numpy(), result.garment_faces.numpy()
        above.append(
            dressed(
                body - here,
                faces[0],
                result.garment[frame].numpy() - here,
                faces[1],
                colliding=inside,
                title=f"frame {frame}: {int(inside.sum())} inside",
            )
        )
        below.append(
            dressed(
                demo.constant_body.numpy(),
                faces[0],
                result.canonical[frame].numpy(),
                faces[1],
                colliding=within,
                title=f"canonical: {int(within.sum())} inside",
            )
        )
    return Scene((*above, *below), columns=len(frames))


def moving(demo: TryOnDemo) -> Scene:
    """Posed and canonical side by side, over time; vertices inside the body are marked."""
    result = demo.result
    here = np.stack([standing_place(body) for body in result.body.numpy()])[:, None]
    here[..., 2] = 0.0
    posed = View(
        (
            Mesh(result.body.numpy() - here, result.body_faces.numpy(), SKIN, name="body"),
            Mesh(
                result.garment.numpy() - here,
                result.garment_faces.numpy(),
                CLOTH,
                name="garment",
                marked=demo.posed.inside.numpy(),
            ),
        ),
        "posed",
    )
    canonical = View(
        (
            Mesh(demo.constant_body.numpy(), result.body_faces.numpy(), SKIN, name="constant body"),
            Mesh(
                result.canonical.numpy(),
                result.garment_faces.numpy(),
                CLOTH,
                name="canonical garment",
                marked=demo.canonical.inside.numpy(),
            ),
        ),
        "canonical",
    )
    return Scene((posed, canonical), columns=2)
