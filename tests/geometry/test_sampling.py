# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false
"""Samples: where they should be, as dense as they should be; normal directions with the right moments."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.geometry.sampling import gaussian_directions, sample_box, sample_shell, sample_surface


@pytest.fixture(scope="module")
def box():
    mesh = trimesh.creation.box(extents=(1, 2, 4))
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def test_surface_samples_are_uniform_by_area(box, rng):
    samples = sample_surface(*box, 20_000, rng)
    assert np.abs(np.abs(samples.point / [0.5, 1, 2]).max(1) - 1).max() < 1e-6
    across_x = np.abs(samples.normal[:, 0]) > 0.9
    assert across_x.mean() == pytest.approx(2 * 4 / (2 * 4 + 1 * 4 + 1 * 2), abs=0.02)


def test_weights_choose_faces(box, rng):
    weight = np.zeros(len(box[1]))
    weight[3] = 1.0
    assert (sample_surface(*box, 100, rng, face_weight=weight).face == 3).all()
    with pytest.raises(ValueError, match="no face has both an area and a weight"):
        sample_surface(*box, 10, rng, face_weight=0 * weight)


def test_a_shell_keeps_its_distance(box, rng):
    points = sample_shell(*box, 5000, 0.1, 0.3, rng)
    outside = np.maximum(np.abs(points) - [0.5, 1, 2], 0)
    distance = np.linalg.norm(outside, axis=1)
    assert distance.min() > 0.0999
    assert distance.max() < 0.3001


def test_a_box_is_filled(rng):
    points = sample_box(np.array([0, 1, 2.0]), np.array([1, 3, 5.0]), 5000, rng)
    np.testing.assert_allclose(points.mean(0), [0.5, 2, 3.5], atol=0.05)


def test_directions_are_normal_and_repeat():
    quasi = gaussian_directions(1024, seed=3)
    assert torch.equal(quasi, gaussian_directions(1024, seed=3))
    assert not torch.equal(quasi, gaussian_directions(1024, seed=4))
    assert quasi.mean(0).abs().max() < 0.01
    assert (quasi.T @ quasi / 1024 - torch.eye(3)).abs().max() < 0.05
    plain = gaussian_directions(1024, seed=3, quasi=False)
    assert quasi.mean(0).norm() < plain.mean(0).norm()
    with pytest.raises(ValueError, match="at least 1"):
        gaussian_directions(0, seed=0)
