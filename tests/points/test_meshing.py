"""A surface through points: where it should be, the same every time; clear when open3d is absent."""

import sys

import numpy as np
import pytest

from workbench.extras import MissingExtra
from workbench.points.meshing import MeshingConfig, poisson_mesh


def sphere(rng, count=4000, radius=0.5):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (radius * normals).astype(np.float32), normals.astype(np.float32)


def test_a_sphere_is_found_again_and_repeats(rng):
    points, normals = sphere(rng)
    mesh = poisson_mesh(points, normals, MeshingConfig(depth=5))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(np.median(radius) - 0.5) < 0.005
    assert np.quantile(np.abs(radius - 0.5), 0.95) < 0.02
    corners = mesh.vertices[mesh.faces]
    outward = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(1)).sum(1)
    assert (outward > 0).mean() > 0.99
    again = poisson_mesh(points, normals, MeshingConfig(depth=5))
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)


def test_unusable_clouds_have_their_line(rng):
    points, normals = sphere(rng, 200)
    with pytest.raises(ValueError, match="200 points, but 100 normals"):
        poisson_mesh(points, normals[:100])
    with pytest.raises(ValueError, match="cannot be reconstructed from 50 points"):
        poisson_mesh(points[:50], normals[:50])
    points[3] = np.nan
    with pytest.raises(ValueError, match="points must be finite, but row 3"):
        poisson_mesh(points, normals)


def test_without_open3d_the_command_is_named(rng, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtra, match=r"needs the package 'open3d'.*\.\[meshing\]"):
        poisson_mesh(*sphere(rng, 200))
