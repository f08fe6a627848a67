"""Evaluation: every row is in the table, every curve in the figure; other lists are told apart."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from widgets.evaluation_view import FAILS, HOLDS, TOLD, draw_curves, draw_rows
from widgets.view import view
from workbench.collisions.subspace import Subspace
from workbench.evaluation_table import at_most, told

ROWS = [at_most("good", 0.5, "%", 1.0), at_most("bad", 2.0, "mm", 1.0), told("baseline", 3.25, "mm")]


def test_the_table_holds_every_row_with_its_colour():
    figure = Figure()
    draw_rows(figure, ROWS)
    cells = figure.axes[0].tables[0].get_celld()
    texts = [[cells[row + 1, column].get_text().get_text() for column in range(4)] for row in range(3)]
    assert texts == [
        ["good", "0.5 %", "<= 1", "yes"],
        ["bad", "2 mm", "<= 1", "NO"],
        ["baseline", "3.25 mm", "", ""],
    ]
    from matplotlib.colors import to_hex

    assert [to_hex(cells[row + 1, 0].get_facecolor()) for row in range(3)] == [HOLDS, FAILS, TOLD]
    panel = view(ROWS)
    assert panel.readout == "3 figures; 1 of 2 bounds hold"
    assert panel.picture().std() > 1


def test_the_curves_are_those_kept_with_the_checkpoint():
    curves = Subspace.shipped("tshirt").story["curves"]
    figure = Figure()
    draw_curves(figure, curves)
    found = {line.get_label(): line.get_ydata() for axes in figure.axes for line in axes.lines}
    assert set(found) == set(curves[0]) - {"step"}
    for name, values in found.items():
        np.testing.assert_array_equal(values, [entry[name] for entry in curves])
    assert f"after {curves[-1]['step']} steps" in view(curves).readout


def test_other_lists_are_told():
    with pytest.raises(TypeError, match="no view of a list of int; there are views of evaluation rows"):
        view([1, 2])
    with pytest.raises(ValueError, match="the list is empty"):
        view([])
