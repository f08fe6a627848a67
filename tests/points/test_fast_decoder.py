"""The fast decoder answers as the plain one does, to rounding."""

import pytest
import torch

from workbench.points.fast_decoder import BLOCK, FastDecoder, folded
from workbench.points.shape_decoder import ShapeDecoder, ShapeDecoderConfig


@pytest.fixture
def decoder(trained_like):
    return trained_like(
        ShapeDecoder(ShapeDecoderConfig(width=32, features=11), generator=torch.Generator().manual_seed(0))
    )


def inputs(count):
    return torch.randn(count, 13, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    ("precision", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-5), (torch.bfloat16, 0.02)]
)
@pytest.mark.parametrize("count", [1, BLOCK + 3])
def test_it_agrees_with_the_plain_decoder(decoder, precision, tolerance, count):
    x = inputs(count)
    if precision == torch.float64:
        decoder, x = decoder.double(), x.double()
    expected = decoder(x)
    fast = FastDecoder(decoder, pose_features=6, precision=precision)
    got = fast(x[:, 2:8], fast.share(x[:, :2], x[:, 8:]))
    for a, b in ((got.displacement, expected.displacement), (got.normal, expected.normal)):
        assert (a - b).abs().max() <= tolerance * b.abs().max()


def test_folding_keeps_a_layer(decoder):
    layer = decoder.shared_layers[1]
    x = torch.randn(40, 32, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(torch.nn.functional.softplus(folded(layer)(x)), layer(x))


def test_counts_that_disagree_are_refused(decoder):
    fast = FastDecoder(decoder, pose_features=6)
    x = inputs(5)
    with pytest.raises(ValueError, match="pose features of 4 queries, but the outfit's share is of 5"):
        fast(x[:4, 2:8], fast.share(x[:, :2], x[:, 8:]))
