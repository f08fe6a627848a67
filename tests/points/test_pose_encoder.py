"""The UNet: the published size, any depth, pixel for pixel."""

import pytest
import torch

from workbench.learning.mlp import parameter_count
from workbench.points.pose_encoder import PoseEncoder, PoseEncoderConfig


def test_the_papers_size():
    """10.35 million parameters (facts.md 2)."""
    encoder = PoseEncoder(generator=torch.Generator().manual_seed(0))
    assert parameter_count(encoder) == pytest.approx(10.35e6, rel=0.002)


@pytest.mark.parametrize("depth", [1, 2, 3, 4, 5])
def test_any_depth_keeps_the_map_s_size(depth):
    encoder = PoseEncoder(PoseEncoderConfig(depth=depth, width=4, features=7), generator=torch.Generator())
    assert encoder(torch.randn(2, 3, 32, 64)).shape == (2, 7, 32, 64)


def test_a_map_that_cannot_be_halved_is_refused():
    encoder = PoseEncoder(PoseEncoderConfig(depth=5, width=4), generator=torch.Generator())
    with pytest.raises(ValueError, match=r"48 x 48 pixels cannot be halved 5 times; .*multiples of 32"):
        encoder(torch.randn(1, 3, 48, 48))
    with pytest.raises(ValueError, match="at least one level"):
        PoseEncoder(PoseEncoderConfig(depth=0), generator=torch.Generator())


def test_a_map_with_too_few_channels_is_refused_and_further_ones_are_not_read():
    generator = torch.Generator().manual_seed(0)
    of_pose, of_both = (
        PoseEncoder(PoseEncoderConfig(depth=3, width=4, features=4, channels=channels), generator=generator).eval()
        for channels in (3, 6)
    )
    image = torch.randn(1, 6, 16, 16, generator=generator)
    torch.testing.assert_close(of_pose(image), of_pose(image[:, :3]))
    assert (of_both(image) - of_both(image.clone().index_fill_(1, torch.tensor([4]), 0.0))).abs().max() > 1e-3
    with pytest.raises(ValueError, match="maps of 6 channels, got 3"):
        of_both(image[:, :3])


def test_one_seed_one_network():
    config = PoseEncoderConfig(depth=3, width=4)
    one, two = (PoseEncoder(config, generator=torch.Generator().manual_seed(4)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True))


def test_frames_do_not_see_each_other_once_trained():
    encoder = PoseEncoder(PoseEncoderConfig(depth=4, width=4, features=3), generator=torch.Generator().manual_seed(0))
    maps = torch.randn(3, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    encoder(maps)
    encoder.eval()
    torch.testing.assert_close(encoder(maps)[1:2], encoder(maps[1:2]), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("depth", "sees_all"), [(2, False), (5, True)])
def test_depth_is_how_far_a_pixel_sees(depth, sees_all):
    """The gradient of one corner's features by the map: local for a shallow UNet, everywhere at full depth."""
    encoder = PoseEncoder(
        PoseEncoderConfig(depth=depth, width=8, features=3), generator=torch.Generator().manual_seed(0)
    )
    encoder.eval()
    image = torch.randn(1, 3, 32, 32, generator=torch.Generator().manual_seed(1)).requires_grad_()
    (slope,) = torch.autograd.grad(encoder(image)[0, :, 0, 0].sum(), image)
    assert bool((slope[0, :, -1, -1].abs() > 0).any()) == sees_all
