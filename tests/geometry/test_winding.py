# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false
"""Winding numbers: 0, 1 and 2, agreement of the fast test with the exact sum, a posed body that overlaps itself."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.winding import InsideTest, check_closed, inside, winding_number


@pytest.fixture(scope="module")
def overlapping():
    """Two spheres of radius 1 and 0.9 whose centres are 0.8 apart, as one mesh."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.asarray(sphere.vertices, np.float32)
    faces = np.asarray(sphere.faces)
    return np.concatenate([vertices, 0.9 * vertices + np.float32([0.8, 0, 0])]), np.concatenate(
        [faces, faces + len(vertices)]
    )


def test_counts_the_layers_around_a_point(overlapping):
    points = np.array([[-0.5, 0, 0], [0.4, 0, 0], [1.3, 0, 0], [3, 0, 0]], np.float32)
    np.testing.assert_allclose(winding_number(points, *overlapping), [1, 2, 1, 0], atol=1e-6)


def test_turning_the_faces_over_changes_the_sign(overlapping):
    vertices, faces = overlapping
    points = np.array([[0.4, 0, 0], [-0.5, 0.1, 0]], np.float32)
    np.testing.assert_allclose(
        winding_number(points, vertices, faces[:, ::-1].copy()), -winding_number(points, vertices, faces), atol=1e-6
    )


def test_half_of_a_sphere_counts_half():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.asarray(sphere.vertices, np.float32)
    upper = np.asarray(sphere.faces)[vertices[sphere.faces][:, :, 2].mean(1) > 0]
    assert winding_number(np.zeros((1, 3), np.float32), vertices, upper)[0] == pytest.approx(
        0.5, abs=0.02
    )  # its rim is ragged


def test_inside_is_the_winding_number_above_one_half(overlapping, rng):
    points = rng.uniform(-1.2, 2, (3000, 3)).astype(np.float32)
    np.testing.assert_array_equal(inside(points, *overlapping), winding_number(points, *overlapping) > 0.5)


def test_a_posed_body_that_overlaps_itself(body, rng):
    """Arms pressed through the torso: the overlap, where the winding number is 2, is inside."""
    vectors = torch.zeros(len(body.parents), 3)
    vectors[body.joint_names.index("LeftArm"), 1] = 0.9
    vectors[body.joint_names.index("RightArm"), 1] = -0.9
    vertices = body.vertices(axis_angle_to_matrix(vectors), body.mean_shape()).numpy()
    faces = body.faces.numpy()
    near = vertices[rng.choice(len(vertices), 150)] + rng.normal(0, 0.004, (150, 3))
    trunk = vertices[faces[body.weights[body.faces[:, 0]].argmax(1).numpy() == body.joint_names.index("LeftArm")]]
    overlap = trunk.mean(1)[:: max(1, len(trunk) // 150)] * [0.9, 1, 1]
    points = np.concatenate([near, overlap]).astype(np.float32)
    exact = winding_number(points, vertices, faces)
    assert (exact > 1.5).sum() > 5
    np.testing.assert_array_equal(InsideTest(vertices, faces)(points), exact > 0.5)


def test_refit_moves_the_inside(overlapping):
    vertices, faces = overlapping
    test = InsideTest(vertices, faces)
    test.refit(vertices + np.float32([5, 0, 0]))
    assert test(np.array([[5, 0, 0], [0, 0, 0]], np.float32)).tolist() == [True, False]


def test_an_open_or_inside_out_mesh_is_refused(overlapping):
    vertices, faces = overlapping
    with pytest.raises(ValueError, match="not closed and consistently oriented: 3 of 7677 directed edges"):
        InsideTest(vertices, faces[1:])
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    with pytest.raises(ValueError, match="orient its faces"):
        check_closed(turned)
