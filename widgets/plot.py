"""Curves, heat maps and tables as pixels, by matplotlib; drawn on any thread, without a window."""

import base64
import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy import ndarray

from widgets.picture import encoded
from widgets.scene import PAPER
from workbench.store import atomic_write

DPI = 100
CURSOR = "#e6006d"
MOST_COLOURED = 10  # curves that get a colour of their own and a name

Pixels = UInt8[ndarray, "H W 3"]


def drawn(size: tuple[int, int], draw: Callable[[Figure], None]) -> Pixels:
    """What `draw` does to an empty figure of `size` pixels."""
    figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor=PAPER, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    draw(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def curves(
    axes: Axes, values: Float[ndarray, "T C"], fps: float, names: tuple[str, ...], title: str, frame: int | None = None
) -> None:
    """One curve a component over seconds; `frame` is where the cursor stands."""
    seconds = np.arange(len(values)) / fps
    for component, name in enumerate(names):
        axes.plot(seconds, values[:, component], lw=1.3, color=f"C{component % MOST_COLOURED}", label=name)
    if frame is not None:
        axes.axvline(frame / fps, color=CURSOR, lw=1.2)
    axes.set_title(title, fontsize=9, loc="left")
    axes.tick_params(labelsize=8)
    axes.margins(x=0)


class FigurePanel:
    """A figure without a scene, shown as a panel is: `.picture(size)`, `.page(path)`, the last line of a cell."""

    def __init__(self, draw: Callable[[Figure], None], readout: str, title: str, size: tuple[int, int]):
        self.draw, self.readout, self.title, self.size = draw, readout, title, size

    def picture(self, size: tuple[int, int] | None = None) -> Pixels:
        """The figure as pixels; it needs no GL."""
        return drawn(size or self.size, self.draw)

    def page(self, path: str | Path) -> Path:
        """One HTML file with the figure in it."""
        path = Path(path)
        title, image = html.escape(self.title), self._base64()
        with atomic_write(path) as part:
            part.write_text(
                f'<!doctype html><meta charset="utf-8"><title>{title}</title><h1>{title}</h1>'
                f'<p>{html.escape(self.readout)}</p><img alt="{title}" src="data:image/png;base64,{image}">',
                encoding="utf-8",
            )
        return path

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        return {"image/png": self._base64(), "text/plain": f"{self.title}; {self.readout}"}

    def _base64(self) -> str:
        return base64.b64encode(encoded(self.picture())).decode("ascii")
