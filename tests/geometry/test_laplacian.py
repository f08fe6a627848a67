"""Laws of workbench.geometry.laplacian."""

import pytest
import torch
import trimesh

from workbench.geometry.laplacian import apply_laplacian, cotangent_laplacian, umbrella_laplacian
from workbench.geometry.mesh import vertex_areas


@pytest.fixture
def sphere():
    mesh = trimesh.creation.icosphere(3, 2.0)
    return torch.tensor(mesh.vertices, dtype=torch.float64), torch.tensor(mesh.faces, dtype=torch.int64)


def both(sphere):
    vertices, faces = sphere
    return umbrella_laplacian(faces, len(vertices), torch.float64), cotangent_laplacian(vertices, faces)


def test_constants_vanish(sphere):
    ones = torch.ones(len(sphere[0]), 3, dtype=torch.float64)
    for laplacian in both(sphere):
        assert apply_laplacian(laplacian, ones).abs().max() < 1e-12


def test_umbrella_is_the_difference_to_the_mean_of_the_neighbours(sphere):
    vertices, faces = sphere
    difference = apply_laplacian(umbrella_laplacian(faces, len(vertices), torch.float64), vertices)
    neighbours = torch.unique(faces[(faces == 5).any(1)])
    neighbours = neighbours[neighbours != 5]
    assert torch.allclose(difference[5], vertices[5] - vertices[neighbours].mean(0))


def test_cotangent_laplacian_is_symmetric_and_positive(sphere):
    dense = cotangent_laplacian(*sphere).to_dense()
    assert torch.allclose(dense, dense.T)
    assert torch.linalg.eigvalsh(dense).min() > -1e-10


def test_mean_curvature_of_a_sphere_is_two_over_its_radius(sphere):
    vertices, faces = sphere
    curvature = apply_laplacian(cotangent_laplacian(vertices, faces), vertices) / vertex_areas(vertices, faces)[:, None]
    assert torch.allclose(curvature, vertices / 2 * (2 / 2.0), rtol=0.1, atol=0.05)


def test_linear_functions_are_harmonic_inside_a_flat_sheet():
    points = torch.tensor([[0, 0, 0], [2, 0, 0], [2, 1.5, 0], [0, 1, 0], [0.7, 0.6, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    assert apply_laplacian(cotangent_laplacian(points, faces), points)[4].abs().max() < 1e-12


def test_a_batch_gives_the_same_as_one_by_one_and_has_a_gradient(sphere):
    vertices, faces = sphere
    laplacian = umbrella_laplacian(faces, len(vertices), torch.float64)
    batch = torch.stack([vertices, vertices**2]).reshape(2, 1, -1, 3).requires_grad_()
    result = apply_laplacian(laplacian, batch)
    assert torch.allclose(result[1, 0], apply_laplacian(laplacian, vertices**2))
    result.square().sum().backward()
    assert batch.grad is not None
    assert batch.grad.isfinite().all()
