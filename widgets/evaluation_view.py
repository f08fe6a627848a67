"""Sec. 6 to look at: rows of `workbench evaluate` -> a table; the curves kept with a checkpoint -> Fig. 4."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from widgets.plot import FigurePanel
from workbench.evaluation_table import Row

ROW_HEIGHT, WIDTH = 22, 980  # pixels
CURVES_SIZE = (900, 380)
HOLDS, FAILS, TOLD = "#d8eedb", "#f6d3d3", "#f7f7f5"
COLLISIONS = "inside"  # curves whose name has it are shares of colliding vertices


def list_view(shown: list) -> FigurePanel:
    """A list of evaluation rows, or of points of a training's curves (`subspace.story["curves"]`).

    Errors: TypeError for any other list; ValueError for an empty one.
    """
    if not shown:
        raise ValueError("there is nothing to look at: the list is empty")
    if all(isinstance(entry, Row) for entry in shown):
        return rows_view(shown)
    if all(isinstance(entry, Mapping) and "step" in entry for entry in shown):
        return curves_view(shown)
    kinds = ", ".join(sorted({type(entry).__name__ for entry in shown}))
    raise TypeError(f"there is no view of a list of {kinds}; there are views of evaluation rows and training curves")


def rows_view(rows: Sequence[Row]) -> FigurePanel:
    """One line a figure, with its bound; red where it is missed."""
    bounded = [row for row in rows if row.holds is not None]
    kept = sum(bool(row.holds) for row in bounded)
    told = f"{len(rows)} figures; {kept} of {len(bounded)} bounds hold"
    size = (WIDTH, ROW_HEIGHT * (len(rows) + 2))
    return FigurePanel(lambda figure: draw_rows(figure, rows), told, "Evaluation", size)


def curves_view(curves: Sequence[Mapping[str, Any]]) -> FigurePanel:
    """Loss and errors over the steps; collisions of unseen and of random garments beside them (Fig. 4)."""
    last, title = curves[-1], "Training (Fig. 4)"
    told = "; ".join(f"{name} {value:.4g}" for name, value in last.items() if name != "step")
    told = f"after {last['step']} steps: {told}"
    return FigurePanel(lambda figure: draw_curves(figure, curves), told, title, CURVES_SIZE)


def draw_rows(figure: Figure, rows: Sequence[Row]) -> None:
    """Metric, value with unit, bound, whether it holds."""
    axes = figure.subplots()
    axes.axis("off")
    words = {True: "yes", False: "NO", None: ""}
    cells = [(row.metric, f"{row.value:.4g} {row.unit}", row.bound, words[row.holds]) for row in rows]
    colours = [[{True: HOLDS, False: FAILS, None: TOLD}[row.holds]] * 4 for row in rows]
    table = axes.table(
        cells,
        cellColours=colours,
        colLabels=("figure", "measured", "bound", "holds"),
        colWidths=(0.62, 0.16, 0.14, 0.08),
        cellLoc="left",
        bbox=Bbox.unit(),
    )
    for cell in table.get_celld().values():
        cell.PAD = 0.02
        cell.set_edgecolor("#cccccc")
    table.auto_set_font_size(False)
    table.set_fontsize(8)


def draw_curves(figure: Figure, curves: Sequence[Mapping[str, Any]]) -> None:
    """Two axes: what is not a collision, and what is, the latter by logarithm."""
    steps = [entry["step"] for entry in curves]
    left, right = figure.subplots(1, 2)
    for name in curves[0]:
        if name == "step":
            continue
        axes = right if COLLISIONS in name else left
        axes.plot(steps, [entry[name] for entry in curves], marker=".", lw=1.3, label=name)
    left.set_title("loss and reconstruction", fontsize=9, loc="left")
    right.set_title("colliding vertices, % (0 is not drawn)", fontsize=9, loc="left")
    right.set_yscale("log", nonpositive="mask")
    for axes in (left, right):
        axes.set_xlabel("steps", fontsize=8)
        axes.tick_params(labelsize=8)
        if axes.lines:
            axes.legend(fontsize=8)
