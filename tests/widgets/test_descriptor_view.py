"""Motion descriptor: the curves are gamma, the body is the motion's, the cursor stands at the frame."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from widgets.descriptor_view import PARTS, DescribedMotion, draw_gamma
from widgets.view import view
from workbench.collisions.motion_descriptor import DescriptorStream
from workbench.collisions.regressor import Regressor
from workbench.formats import load_motion, motion_files


@pytest.fixture(scope="module")
def motion(body):
    files = {path.stem: path for path in motion_files(None)}
    return load_motion(files["test_jack_01"], body).clip(20, 32)


@pytest.fixture(scope="module")
def described(motion):
    return DescribedMotion.of(motion, Regressor.shipped("tshirt").describe)


def test_gamma_is_what_a_stream_gives(motion, described):
    with torch.no_grad():
        stream = DescriptorStream(Regressor.shipped("tshirt").describe, motion.fps)
        frames = [torch.as_tensor(stream(*frame)) for frame in zip(motion.rotations, motion.translation)]
    torch.testing.assert_close(described.gamma, torch.stack(frames), atol=1e-3, rtol=1e-3)


def test_curves_cover_gamma_once_and_the_cursor_stands_at_the_frame(described):
    gamma, found = described.gamma.numpy(), []
    for part in PARTS:
        figure = Figure()
        draw_gamma(figure, gamma, 30.0, part, 6)
        for axes in figure.axes:
            found += [np.asarray(line.get_ydata()) for line in axes.lines[:-1]]
            np.testing.assert_allclose(np.asarray(axes.lines[-1].get_xdata()), 6 / 30)
    np.testing.assert_array_equal(np.stack(found, axis=1), gamma)


def test_the_body_moves_as_the_motion_says(body, motion, described):
    panel = view(described)
    expected = body.vertices(motion.rotations, body.mean_shape(), motion.translation)
    np.testing.assert_allclose(panel.layer("body").vertices, expected.numpy(), atol=1e-6)
    before = panel.layer("body").vertices
    panel["curves"] = "root"
    assert panel.layer("body").vertices is before


def test_a_motion_is_resampled_and_cut(motion):
    panel = view(motion.at_rate(15.0), frames=9)
    assert panel.scene.fps == 30.0
    assert panel.scene.frames == 9
    assert "42 numbers" in panel.readout
    assert panel.plot is not None
    assert not np.array_equal(panel.plot((300, 300), 1), panel.plot((300, 300), 5))
