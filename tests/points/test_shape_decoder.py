"""Eq. 1: the published size, features that are continuous over the body, points that do not depend on their company."""

import pytest
import torch

from workbench.learning.mlp import parameter_count
from workbench.points.shape_decoder import ShapeDecoder, ShapeDecoderConfig, read_features


def test_the_papers_size():
    """0.60 million parameters, residuals in units of 2 cm (facts.md 2)."""
    decoder = ShapeDecoder(generator=torch.Generator().manual_seed(0))
    assert parameter_count(decoder) == pytest.approx(0.60e6, rel=0.01)


def test_a_pixel_s_centre_reads_that_pixel():
    features = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    row, column = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
    u = (torch.stack([column, row], -1).reshape(-1, 2) + 0.5) / 8
    torch.testing.assert_close(read_features(features, u), features.flatten(2).mT)


def test_a_linear_image_is_read_exactly_between_pixels():
    ramp = (torch.arange(16) + 0.5) / 16
    image = torch.stack([ramp.expand(16, 16), ramp[:, None].expand(16, 16)])[None]
    u = 1 / 16 + (7 / 8) * torch.rand(100, 2, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(read_features(image, u)[0], u)


def test_features_are_continuous_where_patches_jump():
    """Fig. 3: crossing a pixel's side by a hair changes bilinear features by a hair, nearest ones by a whole step."""
    features = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    side = torch.tensor([[4 / 8, 0.31]])
    hair = torch.tensor([[1e-5, 0.0]])
    jump = (read_features(features, side + hair) - read_features(features, side - hair)).abs().max()
    nearest = (features[..., 2, 4] - features[..., 2, 3]).abs().max()
    assert jump < 1e-3 * nearest


def test_points_are_decoded_one_by_one_once_trained():
    decoder = ShapeDecoder(ShapeDecoderConfig(width=16, features=10), generator=torch.Generator().manual_seed(0))
    inputs = torch.randn(2, 30, 12, generator=torch.Generator().manual_seed(1))
    decoder(inputs)
    decoder.eval()
    together, alone = decoder(inputs), decoder(inputs[1, 7:9])
    torch.testing.assert_close(together.displacement[1, 7:9], alone.displacement)
    torch.testing.assert_close(together.normal[1, 7:9], alone.normal)


def test_the_branches_are_separate():
    decoder = ShapeDecoder(ShapeDecoderConfig(width=16, features=10), generator=torch.Generator().manual_seed(0)).eval()
    decoder(torch.randn(5, 12)).normal.sum().backward()
    assert all(p.grad is None for p in decoder.displacement.parameters())
    assert all(p.grad is not None for p in decoder.normal.parameters())
    assert all(p.grad is not None for p in decoder.shared.parameters())


def test_displacements_scale():
    generator = torch.Generator().manual_seed(0)
    one = ShapeDecoder(ShapeDecoderConfig(width=16, features=10), generator=generator).eval()
    two = ShapeDecoder(ShapeDecoderConfig(width=16, features=10, displacement_scale=0.06), generator=generator).eval()
    two.load_state_dict(one.state_dict())
    x = torch.randn(5, 12)
    torch.testing.assert_close(two(x).displacement, 3 * one(x).displacement)
    torch.testing.assert_close(two(x).normal, one(x).normal)
