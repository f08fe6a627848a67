# pyright: reportArgumentType=false
"""The layer count is the winding number: agreement with the sum over all faces, ties, posed bodies that overlap."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.geometry.layer_count import LayerCount
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.winding import winding_number


@pytest.fixture(scope="module")
def overlapping():
    """Two spheres of radius 1 and 0.9 whose centres are 0.8 apart, as one mesh."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces)
    both = np.concatenate([vertices, 0.9 * vertices + np.float32([0.8, 0, 0])])
    return both, np.concatenate([faces, faces + len(vertices)])


@pytest.fixture(scope="module")
def cube():
    box = trimesh.creation.box(extents=(2, 2, 2))
    return np.asarray(box.vertices, np.float32), np.asarray(box.faces)


def test_counts_the_layers_around_a_point(overlapping):
    points = np.array([[-0.5, 0, 0], [0.4, 0, 0], [1.3, 0, 0], [3, 0, 0]], np.float32)
    assert LayerCount(*overlapping)(points).tolist() == [1, 2, 1, 0]


def test_is_the_winding_number(overlapping, rng):
    points = rng.uniform(-1.2, 2, (3000, 3)).astype(np.float32)
    np.testing.assert_array_equal(LayerCount(*overlapping)(points), np.round(winding_number(points, *overlapping)))


def test_inside_out_counts_negative(overlapping):
    vertices, faces = overlapping
    turned = LayerCount(vertices, faces[:, ::-1].copy())
    assert turned(np.array([[0.4, 0, 0], [-0.5, 0.1, 0]], np.float32)).tolist() == [-2, -1]


def test_ways_out_through_edges_and_corners_are_counted_once(cube):
    """Every coordinate is one of a cube's: ways out run through its edges, corners and diagonals."""
    grid = np.linspace(-1.5, 1.5, 13)
    points = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    off_surface = np.abs(np.abs(points).max(1) - 1) > 1e-6
    expected = (np.abs(points).max(1) < 1).astype(int)
    np.testing.assert_array_equal(LayerCount(*cube)(points)[off_surface], expected[off_surface])


def test_subdividing_changes_nothing(cube, rng):
    """Points straight below vertices and edges of a fine mesh: the tie-break is the same in all faces around them."""
    box = trimesh.Trimesh(*cube, process=False).subdivide().subdivide().subdivide()
    points = np.asarray(box.vertices, np.float32) * rng.choice([0.5, 0.75, 0.25], (len(box.vertices), 1))
    points = points.astype(np.float32)
    assert (LayerCount(np.asarray(box.vertices, np.float32), np.asarray(box.faces))(points) == 1).all()


@pytest.mark.parametrize("seed", range(3))
def test_on_a_posed_body_that_overlaps_itself(body, seed):
    """Random strong poses, arms pressed through the torso: the unfiltered sum at every point."""
    rng = np.random.default_rng(seed)
    vectors = torch.from_numpy(rng.normal(0, 0.25, (len(body.parents), 3))).float()
    vectors[body.joint_names.index("LeftArm"), 1] = 0.9
    vectors[body.joint_names.index("RightArm"), 1] = -0.9
    vertices = body.vertices(axis_angle_to_matrix(vectors), body.mean_shape()).numpy()
    faces = body.faces.numpy()
    near = vertices[rng.choice(len(vertices), 250)] + rng.normal(0, 0.01, (250, 3))
    arm = faces[body.weights[body.faces[:, 0]].argmax(1).numpy() == body.joint_names.index("LeftArm")]
    within = vertices[arm].mean(1)[:: max(1, len(arm) // 150)] * [0.9, 1, 1]
    points = np.concatenate([near, within]).astype(np.float32)
    exact = winding_number(points, vertices, faces)
    count = LayerCount(body.template.numpy(), faces)
    count.refit(vertices)
    assert (exact > 1.5).sum() > 2
    np.testing.assert_array_equal(count(points), np.round(exact))


def test_an_open_mesh_is_refused(cube):
    with pytest.raises(ValueError, match="not closed and consistently oriented"):
        LayerCount(cube[0], cube[1][1:])


def test_no_points_and_points_far_away(cube):
    count = LayerCount(*cube)
    assert count(np.zeros((0, 3), np.float32)).shape == (0,)
    assert count(np.full((5, 3), 1e6, np.float32)).tolist() == [0] * 5


def test_a_point_on_a_face_counts_as_moved_up_the_first_axis(cube):
    """x first, then y, then z: on the face x = -1 it is inside, on x = 1 outside; in the middle of the way out, too."""
    points = np.array([[-1, 0.3, 0.2], [1, 0.3, 0.2], [0.1, -1, 0.2], [0.1, 1, 0.2], [-1, -1, -1], [-1, 1, 0]])
    assert LayerCount(*cube)(points.astype(np.float32)).tolist() == [1, 0, 1, 0, 1, 0]
