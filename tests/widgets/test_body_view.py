"""Body: what is seen is what Eq. 2-3 computes; a control changes what it must and nothing else."""

import numpy as np
import pytest
import torch

from widgets.body_view import APART, HEAVIEST, PLAIN, body_view
from widgets.panel import Panel
from widgets.view import view
from workbench.geometry.rotations import axis_angle_to_matrix


def meshes(panel):
    return [panel.layer("body, linear"), panel.layer("body, dual", 1)]


@pytest.fixture
def panel(body):
    return body_view(body)


def test_view_dispatches(body):
    assert isinstance(view(body), Panel)
    with pytest.raises(TypeError, match="no view of a dict; there are views of Body"):
        view({})


def test_both_skinnings_are_those_of_the_body(body, panel):
    betas = torch.linspace(-2, 2, body.shape_count)
    panel["beta"] = betas
    panel["joint"] = "RightUpLeg"
    panel["theta"] = (40.0, -10.0, 20.0)
    rotations = axis_angle_to_matrix(torch.zeros(len(body.parents), 3))
    for joint, degrees in (("LeftForeArm", panel.controls["theta"].start), ("RightUpLeg", (40.0, -10.0, 20.0))):
        rotations[body.joint_names.index(joint)] = axis_angle_to_matrix(torch.deg2rad(torch.tensor(degrees)))
    linear, dual = meshes(panel)
    betas = torch.tensor(panel["beta"])
    np.testing.assert_array_equal(linear.vertices, body.vertices(rotations, betas).numpy())
    np.testing.assert_array_equal(dual.vertices, body.vertices(rotations, betas, skinning="dual_quaternion").numpy())


def test_a_joint_keeps_its_turn_while_another_is_chosen(panel):
    start = panel["theta"]
    before = meshes(panel)[0].vertices
    panel["joint"] = "Head"
    assert panel["theta"] == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(meshes(panel)[0].vertices, before)
    panel["joint"] = "LeftForeArm"
    assert panel["theta"] == start


def test_colours_change_no_vertex_and_shape_no_weight(body, panel):
    before = meshes(panel)
    np.testing.assert_array_equal(before[0].scalars.values, body.weights[:, body.joint_names.index("LeftForeArm")])
    panel["colour"] = APART
    after = meshes(panel)
    for old, new in zip(before, after):
        np.testing.assert_array_equal(old.vertices, new.vertices)
    apart = np.linalg.norm(after[0].vertices - after[1].vertices, axis=1)
    np.testing.assert_allclose(after[0].scalars.values, 1e3 * apart, atol=1e-3)
    panel["colour"] = HEAVIEST
    weights = meshes(panel)[0].scalars.values
    panel["beta"] = [1.0] * body.shape_count
    np.testing.assert_array_equal(meshes(panel)[0].scalars.values, weights)
    panel["colour"] = PLAIN
    assert meshes(panel)[0].scalars is None


def test_at_rest_both_skinnings_are_the_shaped_template(body, panel):
    panel.press("rest pose")
    panel.press("mean shape")
    for mesh in meshes(panel):
        np.testing.assert_allclose(mesh.vertices, body.template.numpy(), atol=2e-6)
    assert "0 mm at most" in panel.readout


def test_unknown_joint_is_told(body):
    with pytest.raises(ValueError, match="'tail'"):
        body_view(body, joint="tail")
