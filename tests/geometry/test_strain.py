"""Laws of Eq. 11."""

import pytest
import torch

from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.strain import deformation_gradient, green_strain, principal_stretches, rest_triangles


@pytest.fixture
def sheet() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    vertices = torch.rand(30, 3, generator=generator, dtype=torch.float64)
    faces = torch.stack([torch.randperm(30, generator=generator)[:3] for _ in range(20)])
    return vertices, faces


def test_strain_is_blind_to_rigid_motion(sheet):
    vertices, faces = sheet
    rotation = axis_angle_to_matrix(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64))
    moved = vertices @ rotation.mT + torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    strain = green_strain(deformation_gradient(moved, rest_triangles(vertices, faces)))
    assert strain.abs().max() < 1e-9


def test_uniform_stretch_has_its_analytic_strain(sheet):
    vertices, faces = sheet
    F = deformation_gradient(1.2 * vertices, rest_triangles(vertices, faces))
    expected = 0.5 * (1.2**2 - 1) * torch.eye(2, dtype=torch.float64)
    assert torch.allclose(green_strain(F), expected.expand(20, 2, 2), atol=1e-9)
    assert torch.allclose(principal_stretches(F), torch.full((20, 2), 1.2, dtype=torch.float64))


def test_stretch_along_one_direction_of_the_plane():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2]])
    F = deformation_gradient(vertices * torch.tensor([1.5, 1.0, 1.0]), rest_triangles(vertices, faces))
    assert torch.allclose(principal_stretches(F)[0], torch.tensor([1.5, 1.0]))


def test_strain_has_correct_gradients(sheet):
    vertices, faces = sheet
    rest = rest_triangles(vertices, faces)
    moved = (vertices * torch.tensor([1.1, 0.9, 1.3], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: green_strain(deformation_gradient(x, rest)), moved)


def test_a_triangle_without_area_is_refused():
    with pytest.raises(ValueError, match="rest triangle 1 has no area"):
        rest_triangles(torch.eye(3), torch.tensor([[0, 1, 2], [0, 1, 1]]))
