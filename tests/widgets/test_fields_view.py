"""Fields: a cut shows what Eq. 4-6 give at its points; another joint asks the fields for nothing new."""

import numpy as np
import pytest
import torch

from widgets import fields_view
from widgets.view import view
from workbench.collisions.diffused_body import GridFields, LearnedFields, MonteCarloFields
from workbench.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(scope="module")
def panel():
    return view(GridFields.default(), LearnedFields.default(), across=24)


def points(panel):
    return torch.from_numpy(panel.layer("cut").vertices)


def test_weights_are_those_of_each_implementation(body, panel):
    panel["quantity"] = fields_view.WEIGHTS
    panel["joint"] = "RightUpLeg"
    joint = body.joint_names.index("RightUpLeg")
    for index, fields in enumerate((GridFields.default(), LearnedFields.default())):
        with torch.no_grad():
            expected = fields.weights(points(panel))
        np.testing.assert_array_equal(panel.layer("cut", index).scalars.values, expected[:, joint].numpy())
        panel["quantity"] = fields_view.HEAVIEST
        shown = panel.layer("cut", index).scalars
        np.testing.assert_array_equal(shown.values, expected.argmax(-1).numpy())
        assert shown.categories == body.joint_names
        panel["quantity"] = fields_view.WEIGHTS
    assert [v.title for v in panel.scene.views] == ["table", "networks"]


def test_offsets_follow_beta_and_theta(body, panel):
    grid = GridFields.default()
    panel["quantity"] = fields_view.SHAPE
    panel["beta"] = [0.5] * 10
    expected = grid.shape_offsets(points(panel), torch.full((10,), 0.5)).norm(dim=-1)
    np.testing.assert_allclose(panel.layer("cut").scalars.values, 1e3 * expected.numpy(), rtol=1e-5)
    assert panel.layer("cut").scalars.limits == panel.layer("cut", 1).scalars.limits
    panel["quantity"] = fields_view.POSE
    panel["joint"], panel["theta"] = "LeftUpLeg", (70.0, 0.0, 10.0)
    rotations = body.rest_rotations()
    rotations[body.joint_names.index("LeftUpLeg")] = axis_angle_to_matrix(torch.deg2rad(torch.tensor([70.0, 0, 10])))
    expected = grid.pose_offsets(points(panel), body.pose_feature(rotations)).norm(dim=-1)
    np.testing.assert_allclose(panel.layer("cut").scalars.values, 1e3 * expected.numpy(), rtol=1e-5, atol=1e-5)


def test_apart_is_nothing_from_itself(panel):
    panel["quantity"] = fields_view.DIFFERENCE
    assert panel.layer("cut").scalars.values.max() == 0
    assert panel.layer("cut", 1).scalars.values.max() > 0.01


def test_another_joint_asks_for_no_new_weights(body, monkeypatch):
    asked = []
    grid = GridFields(GridFields.default().grid, body)
    weights = grid.weights
    monkeypatch.setattr(grid, "weights", lambda p: asked.append(len(p)) or weights(p))
    panel = view(grid, across=20)
    panel["joint"] = "Head"
    panel["quantity"] = fields_view.HEAVIEST
    assert len(asked) == 1
    panel["place of the cut"] = 0.6
    assert len(asked) == 2


def test_monte_carlo_tells_its_samples(body):
    panel = view(MonteCarloFields(body, samples=2), across=8)
    assert panel.scene.views[0].title == "Monte Carlo (2 samples)"
    assert panel.layer("body").opacity < 1


def test_names_that_do_not_fit_are_told():
    with pytest.raises(ValueError, match="2 names for 1 implementations"):
        view(GridFields.default(), names=("a", "b"))
