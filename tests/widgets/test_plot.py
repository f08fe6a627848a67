"""Figures as pixels: of the size asked for, with what was drawn, on any thread."""

import threading

import numpy as np
from matplotlib.figure import Figure

from widgets.plot import FigurePanel, curves, drawn


def draw(figure):
    figure.subplots().plot([0, 1], [0, 1], color="red")


def test_pixels_have_the_size_and_the_drawing():
    pixels = drawn((160, 120), draw)
    assert pixels.shape == (120, 160, 3)
    assert ((pixels[..., 0] > 200) & (pixels[..., 1] < 60)).sum() > 50


def test_any_thread_draws_the_same():
    made = []
    thread = threading.Thread(target=lambda: made.append(drawn((160, 120), draw)))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(made[0], drawn((160, 120), draw))


def test_curves_are_the_components_over_seconds_with_a_cursor():
    values = np.arange(12.0).reshape(6, 2)
    axes = Figure().subplots()
    curves(axes, values, 3.0, ("a", "b"), "title", frame=3)
    for component, line in enumerate(axes.lines[:2]):
        np.testing.assert_array_equal(np.asarray(line.get_ydata()), values[:, component])
        np.testing.assert_allclose(np.asarray(line.get_xdata()), np.arange(6) / 3)
    np.testing.assert_array_equal(axes.lines[2].get_xdata(), [1.0, 1.0])


def test_a_figure_is_shown_and_written(tmp_path):
    panel = FigurePanel(draw, "red line", "A <figure>", (160, 120))
    assert panel._repr_mimebundle_()["text/plain"] == "A <figure>; red line"
    assert panel.picture((200, 100)).shape == (100, 200, 3)
    page = panel.page(tmp_path / "a.html").read_text()
    assert "A &lt;figure&gt;" in page
    assert "data:image/png;base64," in page
