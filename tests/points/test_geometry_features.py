"""One tensor an outfit: shared by its frames, learned at its own pace, smoothed."""

import pytest
import torch

from workbench.points.geometry_features import START, GeometryFeatures, GeometryFeaturesConfig

CONFIG = GeometryFeaturesConfig(size=32, features=8)


@pytest.fixture
def features():
    return GeometryFeatures(3, CONFIG, generator=torch.Generator().manual_seed(0))


def test_frames_of_one_outfit_share_it(features):
    read = features(torch.tensor([2, 0, 2]))
    assert torch.equal(read[0], read[2])
    assert not torch.equal(read[0], read[1])
    torch.testing.assert_close(read[1], features.smooth(features.tensors[:1])[0])


def test_only_named_outfits_learn(features):
    features(torch.tensor([1, 1])).sum().backward()
    assert features.stored.grad[0].abs().max() == 0
    assert features.stored.grad[1].abs().max() > 0


def test_it_starts_as_small_noise_and_the_mean_is_theirs(features):
    assert features.tensors.std().item() == pytest.approx(START, rel=0.05)
    torch.testing.assert_close(features.mean(), features.tensors.mean(0))


def test_an_adam_step_moves_it_pace_times_as_far(features):
    before = features.tensors.detach().clone()
    optimizer = torch.optim.Adam(features.parameters(), lr=3e-4)
    (features.tensors * torch.randn(features.stored.shape)).sum().backward()
    optimizer.step()
    torch.testing.assert_close((features.tensors - before).abs().mean(), torch.tensor(5e-4), rtol=1e-2, atol=0)


def test_smoothing_quiets_noise_and_is_linear(features):
    one, two = (torch.randn(1, 8, 32, 32, generator=torch.Generator().manual_seed(k)) for k in range(2))
    zero = features.smooth(torch.zeros_like(one))
    torch.testing.assert_close(
        features.smooth(2 * one + two) - zero,
        2 * (features.smooth(one) - zero) + features.smooth(two) - zero,
        atol=1e-5,
        rtol=1e-4,
    )

    def roughness(image):
        return ((image[..., 1:] - image[..., :-1]).square().mean() / image.var()).item()

    assert roughness(features.smooth(one)) < 0.75 * roughness(one)


def test_no_outfit_is_refused():
    with pytest.raises(ValueError, match="at least one outfit, got 0"):
        GeometryFeatures(0, CONFIG, generator=torch.Generator())
