"""Cuts: flat, regular, where they are asked for; the level line lies where the quantity passes the level."""

import numpy as np
import pytest
import torch

from widgets.scene import Scalars
from widgets.slice_plane import ACROSS, SliceControls, SlicePlane

LOW, HIGH = np.array([-1.0, -0.5, 0.0], np.float32), np.array([1.0, 0.5, 1.5], np.float32)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_cut_covers_the_box_at_its_place(axis):
    plane = SlicePlane.of(LOW, HIGH, axis, 0.25, 41)
    assert (plane.points[:, axis] == np.float32(0.25)).all()
    others = [other for other in range(3) if other != axis]
    np.testing.assert_allclose(plane.points[:, others].min(0), LOW[others], atol=1e-6)
    step = max(HIGH[others] - LOW[others]) / 40
    assert (plane.points[:, others].max(0) >= HIGH[others] - step).all()
    assert max(plane.shape) == 41
    a, b, c = (plane.points[plane.faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(np.prod(np.ptp(plane.points[:, others], axis=0)), rel=1e-5)


def test_the_level_line_of_a_ball_is_a_circle():
    plane = SlicePlane.of(LOW, HIGH, 1, 0.0, 101)
    distance = np.linalg.norm(plane.points - [0, 0, 0.75], axis=1) - 0.5
    line = plane.level_line(distance, 0.1).positions
    assert len(line) > 50
    np.testing.assert_allclose(np.linalg.norm(line - [0, 0, 0.75], axis=1), 0.6, atol=1e-3)
    assert len(plane.level_line(distance + 9, 0.0).positions) == 0


def test_controls_place_the_cut():
    cut = SliceControls.around(torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]))
    for direction, axis in ACROSS.items():
        cut.direction.set(direction)
        for place in (0.0, 0.5, 1.0):
            cut.place.set(place)
            expected = cut.low[axis] + place * (cut.high[axis] - cut.low[axis])
            plane = cut.plane(20)
            np.testing.assert_allclose(plane.points[:, axis], expected, atol=1e-6)
            assert cut.camera(1.0).target == pytest.approx(((cut.low + cut.high) / 2).tolist(), abs=0.2)
    assert plane.coloured(Scalars(plane.points[:, 0], "x")).name == "cut"
