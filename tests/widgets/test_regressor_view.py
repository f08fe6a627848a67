"""Regressor: curves are its latents, the garment is what they decode to, marks are exact; beta moves all of it."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from widgets.regressor_view import NAMED, draw_latents, regressor_view
from widgets.view import view
from workbench.collisions.penetration import penetration
from workbench.collisions.regressor import Regressor
from workbench.collisions.subspace import Subspace
from workbench.formats import load_motion, motion_files


@pytest.fixture(scope="module")
def motion(body):
    files = {path.stem: path for path in motion_files(None)}
    return load_motion(files["test_jack_01"], body).clip(20, 32)


def test_the_garment_is_decoded_from_the_latents(body, motion):
    regressor, subspace = Regressor.shipped("tshirt"), Subspace.shipped("tshirt")
    panel = regressor_view(regressor, motion, subspace=subspace, frames=4, every=3)
    for beta in ([0.0] * 10, [1.5, -1.0, *[0.0] * 8]):
        panel["beta"] = beta
        with torch.no_grad():
            latents = regressor(motion.rotations[None], motion.translation[None], torch.tensor(beta)[None])[0]
            X = subspace.decode(latents[::3])
        np.testing.assert_allclose(panel.layer("garment").vertices, X.numpy(), atol=1e-6)
        exact = penetration(body.template[None], body.faces, torch.from_numpy(panel.layer("garment").vertices)).inside
        np.testing.assert_array_equal(panel.layer("garment").marked, exact.numpy())
        assert panel.readout.startswith(f"{int(exact.sum())} of {exact.numel():,}")
    panel.press("mean shape")
    assert panel["beta"] == (0.0,) * 10


def test_every_latent_is_drawn_once(motion):
    latents = np.random.default_rng(0).normal(size=(8, 25)).cumsum(0)
    figure = Figure()
    draw_latents(figure, latents, 30.0, 2)
    drawn = [np.asarray(line.get_ydata()) for line in figure.axes[0].lines if len(np.asarray(line.get_ydata())) == 8]
    assert len(drawn) == 25
    assert {tuple(line) for line in drawn} == {tuple(column) for column in latents.T}
    spread = np.sort(latents.std(0))[-NAMED:]
    np.testing.assert_allclose(sorted(line.std() for line in drawn[-NAMED:]), spread)


def test_shipped_motions_can_be_chosen():
    panel = view(Regressor.shipped("tshirt"), frames=2)
    before = panel.layer("garment").vertices
    panel["motion"] = panel.controls["motion"].options[0]
    assert not np.array_equal(panel.layer("garment").vertices, before)
