"""Garment model: the three views are X, Eq. 8 and Eq. 7, each on its body, with exact marks."""

import numpy as np
import pytest
import torch

from widgets.view import view
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import penetration
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(scope="module")
def model(body):
    return GarmentModel(body, GridFields.default())


@pytest.fixture
def panel(model):
    return view(model)


def test_each_view_is_what_its_equation_gives(body, model, panel):
    panel["beta"] = torch.linspace(1, -1, 10)
    panel["joint"], panel["theta"] = "RightArm", (0.0, 50.0, 5.0)
    rotations = body.rest_rotations()
    for joint, degrees in (("LeftArm", panel.controls["theta"].start), ("RightArm", (0.0, 50.0, 5.0))):
        rotations[body.joint_names.index(joint)] = axis_angle_to_matrix(torch.deg2rad(torch.tensor(degrees)))
    betas, X = torch.tensor(panel["beta"]), Garment.load("tshirt").vertices
    state = model.state(rotations, betas)
    expected = [
        (X, body.template),
        (model.unposed(X, state), body.unposed(rotations, betas)),
        (model.posed(X, state), body.vertices(rotations, betas)),
    ]
    for index, (garment, surface) in enumerate(expected):
        mesh = panel.layer("garment", index)
        np.testing.assert_allclose(mesh.vertices, garment.numpy(), atol=1e-6)
        np.testing.assert_allclose(panel.layer("body", index).vertices, surface.numpy(), atol=1e-6)
        exact = penetration(surface[None], body.faces, torch.from_numpy(mesh.vertices)[None]).inside[0]
        np.testing.assert_array_equal(mesh.marked, exact.numpy())
        assert panel.scene.views[index].title.endswith(f": {int(exact.sum())} inside")


def test_theta_leaves_the_canonical_garment_and_beta_too(panel):
    canonical = panel.layer("garment").vertices
    posed = panel.layer("garment", 2).vertices
    panel["theta"] = (0.0, 60.0, 0.0)
    panel["beta"] = [1.0] * 10
    np.testing.assert_array_equal(panel.layer("garment").vertices, canonical)
    assert np.abs(panel.layer("garment", 2).vertices - posed).max() > 0.1


def test_at_rest_on_the_mean_shape_all_three_are_one(panel):
    panel.press("undo all turns")
    panel.press("mean shape")
    for index in (1, 2):
        np.testing.assert_allclose(panel.layer("garment", index).vertices, panel.layer("garment").vertices, atol=1e-5)


def test_a_given_state_is_where_it_starts(body, model):
    rotations = body.rest_rotations()
    rotations[0] = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 1.0]))
    garment = Garment.load("dress")
    panel = view(model, garment, canonical=garment.vertices + 0.01, rotations=rotations, betas=[0.0] * 10)
    expected = model.posed(garment.vertices + 0.01, model.state(rotations, body.mean_shape()))
    np.testing.assert_allclose(panel.layer("garment", 2).vertices, expected.numpy(), atol=1e-6)
