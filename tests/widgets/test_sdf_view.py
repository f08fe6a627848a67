"""SDF: cuts show the distance, their line lies on the surface, and a level set is that far away from the body."""

import numpy as np
import pytest
import torch

from widgets import sdf_view
from widgets.view import view
from workbench.collisions.body_sdf import BodySDF, ExactSDF, GridSDF


@pytest.fixture(scope="module")
def panel():
    return view(GridSDF.default(), across=40)


def test_a_cut_shows_the_distance_and_its_zero_line(panel):
    panel["look"] = sdf_view.CUT
    cut = panel.layer("cut")
    expected = GridSDF.default()(torch.from_numpy(cut.vertices)).numpy()
    np.testing.assert_allclose(cut.scalars.values, 1e3 * expected, atol=1e-3)
    line = panel.layer("zero line").positions
    assert len(line) > 40
    assert np.abs(GridSDF.default()(torch.from_numpy(line)).numpy()).max() < 0.02  # a step of the net is 0.05
    assert panel.scene.views[0].title == "table"


def test_errors_are_those_to_the_exact_distance(body, panel):
    panel["look"] = sdf_view.ERROR
    cut = panel.layer("cut")
    points = torch.from_numpy(cut.vertices)
    expected = (GridSDF.default()(points) - ExactSDF(body)(points)).abs().numpy()
    np.testing.assert_allclose(cut.scalars.values, 1e3 * expected, atol=1e-3)
    assert f"{1e3 * expected.mean():.2f} mm" in panel.readout


@pytest.mark.parametrize("level", [0.0, 40.0])
def test_a_level_set_is_that_far_off(body, panel, level):
    panel["look"] = sdf_view.LEVEL
    panel["level (mm)"] = level
    shell = panel.layer("level set")
    distance = ExactSDF(body)(torch.from_numpy(shell.vertices)).numpy()
    assert np.abs(1e3 * distance - level).mean() < 1.0
    assert len(shell.faces) > 1000


def test_a_level_that_is_nowhere_is_told(body):
    class Far(BodySDF):
        def __call__(self, points):
            return torch.full(points.shape[:-1], 9.0)

    panel = view(Far(), across=8, body=body)
    assert panel.scene.views[0].title == "Far"
    with pytest.raises(ValueError, match="the distance is 0 mm nowhere in the box"):
        panel["look"] = sdf_view.LEVEL


def test_names_that_do_not_fit_are_told():
    with pytest.raises(ValueError, match="2 names for 1 distances"):
        view(GridSDF.default(), names=("a", "b"))
