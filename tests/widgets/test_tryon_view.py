"""Try-on: what plays is what the runtime computes; marks are the exact counts; sliders change what they must."""

import numpy as np
import pytest
import torch

from widgets.tryon_view import dressed_frames
from widgets.view import view
from workbench.collisions.penetration import penetration
from workbench.collisions.tryon import TryOn
from workbench.motion import Motion


@pytest.fixture(scope="module")
def tryon():
    return TryOn.shipped("tshirt")


@pytest.fixture(scope="module")
def motion(body):
    from workbench.formats import load_motion, motion_files

    files = {path.stem: path for path in motion_files(None)}
    return load_motion(files["test_jack_01"], body).clip(30, 45)


@pytest.fixture(scope="module")
def panel(tryon, motion):
    made = view(tryon, motion, frames=4, every=3)
    made["clear limbs off the body"] = False
    return made


def test_thinned_frames_are_those_of_the_whole_run(tryon, motion: Motion):
    betas = torch.linspace(-1, 1, 10)
    whole, thin = tryon.run(motion, betas), dressed_frames(tryon, motion, betas, every=4)
    assert thin.motion.fps == motion.fps / 4
    for name in ("latent", "canonical", "garment", "body"):
        torch.testing.assert_close(getattr(thin, name), getattr(whole, name)[::4], atol=2e-5, rtol=0)


def test_marks_are_the_exact_counts_of_both_spaces(body, panel, tryon, motion):
    panel["beta"] = [2.0, 2.0, -2.0, *[0.0] * 7]
    result = dressed_frames(tryon, motion.clip(0, 12), torch.tensor(panel["beta"]), 3)
    posed = penetration(result.body, result.body_faces, result.garment).inside
    canonical = penetration(body.template[None], result.body_faces, result.canonical).inside
    np.testing.assert_array_equal(panel.layer("garment").marked, posed.numpy())
    np.testing.assert_array_equal(panel.layer("canonical garment", 1).marked, canonical.numpy())
    assert f"{int(posed.sum()):,} of {posed.numel():,} vertices" in panel.readout
    assert posed.any()


def test_body_and_garment_move_together_and_stay_in_place(panel, tryon, motion):
    result = dressed_frames(tryon, motion.clip(0, 12), torch.tensor(panel["beta"]), 3)
    shown = panel.layer("garment").vertices - panel.layer("body").vertices[:, :1]
    np.testing.assert_allclose(shown, (result.garment - result.body[:, :1]).numpy(), atol=1e-5)
    middle = panel.layer("body").vertices
    middle = (middle.min(1) + middle.max(1)) / 2
    np.testing.assert_allclose(middle[:, :2], 0, atol=1e-5)


def test_a_shape_slider_changes_all_but_the_constant_body(panel):
    before = {name: panel.layer(name, v).vertices for name, v in (("body", 0), ("garment", 0), ("constant body", 1))}
    panel.press("mean shape")
    assert np.abs(panel.layer("body").vertices - before["body"]).max() > 0.01
    assert np.abs(panel.layer("garment").vertices - before["garment"]).max() > 0.01
    np.testing.assert_array_equal(panel.layer("constant body", 1).vertices, before["constant body"])


def test_clearing_moves_the_body(panel):
    before = panel.layer("body").vertices
    panel["clear limbs off the body"] = True
    assert np.abs(panel.layer("body").vertices - before).max() > 0
    panel["clear limbs off the body"] = False
    np.testing.assert_array_equal(panel.layer("body").vertices, before)


def test_a_result_is_shown_as_it_is(tryon, motion):
    result = tryon.run(motion.clip(0, 3), torch.zeros(10))
    shown = view(result)
    assert shown.scene.frames == 3
    np.testing.assert_array_equal(
        shown.layer("garment").marked, penetration(result.body, result.body_faces, result.garment).inside.numpy()
    )
    np.testing.assert_array_equal(shown.layer("canonical garment", 1).vertices, result.canonical.numpy())


def test_shipped_motions_can_be_chosen(tryon):
    shown = view(tryon, frames=2, every=2)
    names = shown.controls["motion"].options
    assert len(names) == 22
    before = shown.layer("body").vertices
    shown["motion"] = names[-1]
    assert not np.array_equal(shown.layer("body").vertices, before)
