"""Collisions to look at: InspectionResult -> the sequence beside a heat map of frames and body regions."""

import numpy as np
from jaxtyping import Int
from matplotlib.figure import Figure
from numpy import ndarray

from widgets.inspector_view import inspection_scene, shown_frames, write_inspection
from widgets.panel import Panel, Pixels
from widgets.plot import CURSOR, FigurePanel, drawn
from workbench.collisions.inspection import Inspection
from workbench.inspector import InspectionResult

SIZE = (640, 460)
MAP_SIZE = (900, 420)


def inspection_result_view(result: InspectionResult) -> Panel:
    """Body and garment with what collides marked; its cursor in the heat map.  `.page` is the inspector's page.

    Errors: ValueError for meshes too large for a browser (`workbench inspect` reports on them without a 3-D view).
    """
    frames = shown_frames(result)
    if not len(frames):
        raise ValueError("these meshes are too large to turn here; `workbench inspect` reports on them without")
    scene = inspection_scene(result, frames)

    def plot(size: tuple[int, int], frame: int) -> Pixels:
        return drawn(size, lambda figure: draw_heat_map(figure, result.found, int(frames[frame])))

    return Panel(
        (),
        lambda: scene,
        lambda: told(result.found),
        plot=plot,
        title="Collisions",
        size=SIZE,
        write=lambda path: write_inspection(result, path),
    )


def inspection_view(found: Inspection) -> FigurePanel:
    """The heat map alone: an Inspection holds no meshes."""
    return FigurePanel(lambda figure: draw_heat_map(figure, found, None), told(found), "Collisions", MAP_SIZE)


def told(found: Inspection) -> str:
    """The counts, in words."""
    inside, frames = found.inside, len(found.layers)
    return (
        f"{int(inside.sum()):,} of {inside.numel():,} vertices of all frames inside the body "
        f"({100 * float(inside.float().mean()):.3f} %), in {int(inside.any(dim=1).sum())} of {frames} frames; "
        f"deepest {1e3 * float(found.depth.max()):.1f} mm"
    )


def draw_heat_map(figure: Figure, found: Inspection, frame: int | None) -> None:
    """Colliding vertices of each frame in each region that has any."""
    counts = found.heat_map.numpy()
    hit = np.flatnonzero(counts.any(axis=0))
    axes = figure.subplots()
    if not len(hit):
        axes.text(0.5, 0.5, "nothing collides", ha="center", transform=axes.transAxes)
        axes.axis("off")
        return
    shown = axes.imshow(_masked(counts[:, hit].T), aspect="auto", cmap="YlOrRd", vmin=0, interpolation="nearest")
    axes.set_yticks(range(len(hit)), [found.regions.names[region] for region in hit], fontsize=8)
    axes.set_xlabel("frame", fontsize=8)
    axes.tick_params(labelsize=8)
    if frame is not None:
        axes.axvline(frame, color=CURSOR, lw=1.2)
    figure.colorbar(shown, ax=axes, label="colliding vertices", shrink=0.7)


def _masked(counts: Int[ndarray, "R T"]) -> np.ma.MaskedArray:
    """Nothing where nothing collides."""
    return np.ma.masked_equal(counts, 0)
