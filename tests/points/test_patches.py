"""Patches: constant features within, jumps between; the baseline's own size and shape."""

import pytest
import torch

from workbench.points.patches import PatchModel, PatchModelConfig, patch_grid, pixel_of
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.uv_position_map import atlas_of, posed_bodies, posed_queries

CONFIG = PatchModelConfig(
    encoder=PoseEncoderConfig(depth=3, width=4, features=6), decoder=ShapeDecoderConfig(width=16, features=8), side=3
)


@pytest.fixture
def asked(body):
    atlas = atlas_of(body, 32)
    bodies = posed_bodies(body, body.rest_rotations()[None], body.mean_shape())
    return atlas.map_of(bodies.neutral), posed_queries(atlas.queries, bodies), atlas


def test_each_patch_has_its_points_around_it(asked):
    image, posed, atlas = asked
    model = PatchModel(CONFIG, generator=torch.Generator().manual_seed(0)).eval()
    cloud = model(image, torch.tensor([0]), posed)
    assert cloud.points.shape == (1, 9 * len(atlas.pixel), 3)
    torch.nn.init.zeros_(model.decoder.to_displacement.weight)
    still = model(image, torch.tensor([0]), posed)
    torch.testing.assert_close(still.points[0, ::9], posed.points[0])
    torch.testing.assert_close(still.points[0, 8::9], posed.points[0])


def test_patches_may_be_sampled_denser(asked):
    image, posed, _ = asked
    model = PatchModel(CONFIG, generator=torch.Generator().manual_seed(0)).eval()
    features = model.encoder(image)
    few, many = model.decode(features, posed, 3), model.decode(features, posed, 9)
    # the middle of the 9 x 9 grid is the middle of the 3 x 3 one
    torch.testing.assert_close(many.points[0, 40::81], few.points[0, 4::9])


def test_grids_are_spread_evenly():
    grid = patch_grid(4)
    assert grid.shape == (16, 2)
    torch.testing.assert_close(grid.mean(0), torch.zeros(2))
    assert grid.abs().max() == 0.75


def test_pixels_of_centres(asked):
    _, posed, atlas = asked
    assert torch.equal(pixel_of(posed.u, 32), atlas.pixel)


def test_what_does_not_fit_is_refused(asked):
    image, posed, _ = asked
    model = PatchModel(CONFIG, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"patches are of one outfit, got 2 .*train one model each"):
        two = type(posed)(posed.u, posed.points.expand(2, -1, -1), posed.transforms.expand(2, -1, -1, -1))
        model(image.expand(2, -1, -1, -1), torch.tensor([0, 1]), two)
    with pytest.raises(ValueError, match=r"set decoder.features to 66"):
        PatchModelConfig(decoder=ShapeDecoderConfig(features=64))
    assert model.penalised().square().sum() == 0
