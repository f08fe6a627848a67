"""Signed distance: the analytic sphere, and the two ways to ask."""

import numpy as np
import pytest
import trimesh

from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.signed_distance import SignedDistance, signed_distance


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=5)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def test_a_sphere_is_its_radius_away(sphere, rng):
    points = rng.normal(size=(2000, 3)).astype(np.float32)
    distance = SignedDistance(*sphere)(points)
    np.testing.assert_allclose(distance, np.linalg.norm(points, axis=1) - 1, atol=1e-3)


def test_both_ways_agree_and_move_with_the_mesh(sphere, rng):
    vertices, faces = sphere
    points = rng.normal(size=(300, 3)).astype(np.float32)
    distance = SignedDistance(vertices, faces)
    np.testing.assert_array_equal(distance(points), signed_distance(points, ClosestPoint(vertices, faces)))
    distance.refit(2 * vertices)
    np.testing.assert_allclose(distance(points), np.linalg.norm(points, axis=1) - 2, atol=2e-3)


def test_a_mesh_with_a_hole_has_no_inside(sphere):
    vertices, faces = sphere
    with pytest.raises(ValueError, match="not closed"):
        SignedDistance(vertices, faces[:-1])
