"""Eq. 2 and the model around it."""

import pytest
import torch

from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.points.clothed_points import PointModel, PointModelConfig, posed_normals, posed_points
from workbench.points.geometry_features import GeometryFeaturesConfig
from workbench.points.uv_position_map import atlas_of, posed_bodies, posed_queries


def frames(body, count=2):
    generator = torch.Generator().manual_seed(0)
    rotations = axis_angle_to_matrix(0.2 * torch.randn(count, len(body.parents), 3, generator=generator))
    return posed_bodies(body, rotations, body.mean_shape())


def test_eq_2_and_its_gradient():
    generator = torch.Generator().manual_seed(0)
    T, r, p = (
        torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((2, 4, 3, 3), (2, 4, 3), (2, 4, 3))
    )
    torch.testing.assert_close(posed_points(T, r, p)[1, 2], T[1, 2] @ r[1, 2] + p[1, 2])
    assert torch.autograd.gradcheck(posed_points, tuple(x.requires_grad_() for x in (T, r, p)))
    assert torch.autograd.gradcheck(posed_normals, (T, r))
    torch.testing.assert_close(posed_normals(T, r).norm(dim=-1), torch.ones(2, 4, dtype=torch.float64))


def test_no_displacement_is_the_body(body, small_model):
    """With the last layer at zero every point lies on the posed body of its own shape."""
    torch.nn.init.zeros_(small_model.decoder.to_displacement.weight)
    torch.nn.init.zeros_(small_model.decoder.to_displacement.bias)
    atlas, bodies = atlas_of(body, 32), frames(body)
    posed = posed_queries(atlas.queries, bodies)
    cloud = small_model(atlas.map_of(bodies.neutral), torch.tensor([0, 1]), posed)
    torch.testing.assert_close(cloud.points, posed.points)


def test_a_turned_frame_gives_turned_clothes(body, small_model, trained_like):
    """Equivariance: the pose code being the same, points and normals turn with the bodies' transforms."""
    model = trained_like(small_model)
    atlas, bodies = atlas_of(body, 32), frames(body, 1)
    posed = posed_queries(atlas.queries, bodies)
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 0.7]))
    turned = type(posed)(posed.u, posed.points @ turn.mT, turn @ posed.transforms)
    image, outfit = atlas.map_of(bodies.neutral), torch.tensor([2])
    one, two = model(image, outfit, posed), model(image, outfit, turned)
    torch.testing.assert_close(two.points, one.points @ turn.mT, atol=1e-5, rtol=0)
    torch.testing.assert_close(two.normals, one.normals @ turn.mT, atol=1e-5, rtol=0)


def test_any_density_agrees_where_it_asks_for_the_same_points(body, small_model, trained_like):
    model = trained_like(small_model)
    coarse, bodies = atlas_of(body, 32), frames(body, 1)
    image = coarse.map_of(bodies.neutral)
    fine = atlas_of(body, 96)  # every third pixel's centre is one of the coarse map
    third = torch.full((96 * 96,), -1)
    third[fine.pixel] = torch.arange(len(fine.pixel))
    same = third[(3 * (coarse.pixel // 32) + 1) * 96 + 3 * (coarse.pixel % 32) + 1]
    assert (same >= 0).all()
    one = model(image, torch.tensor([0]), posed_queries(coarse.queries, bodies))
    two = model(image, torch.tensor([0]), posed_queries(fine.queries, bodies))
    torch.testing.assert_close(two.points[:, same], one.points, atol=1e-5, rtol=0)


def test_features_must_add_up():
    with pytest.raises(ValueError, match=r"reads 128 features, but the encoder and G give 64 \+ 32; set .* to 96"):
        PointModelConfig(geometry=GeometryFeaturesConfig(features=32))


def test_one_seed_one_model(small_model):
    again = PointModel(3, small_model.config, generator=torch.Generator().manual_seed(0))
    assert all(torch.equal(a, b) for a, b in zip(small_model.parameters(), again.parameters(), strict=True))
