"""LayerNorm in lanes is LayerNorm, whatever the width; ReLU and what is added come before it."""

import numpy as np
import pytest
import torch
import warp as wp
from torch.nn.functional import layer_norm

from workbench.collisions.limb_kernels import add_rectify_and_normalise
from workbench.collisions.network_kernels import rectify_and_normalise
from workbench.geometry.warp_launch import Recorded, shared_array

ROWS = 3


@pytest.mark.parametrize("width", [1, 5, 16, 37, 256])
def test_rows_are_rectified_and_normalised(width):
    chance = np.random.default_rng(width)
    values, own = chance.normal(1, 2, (2, ROWS, width)).astype(np.float32)
    common, scale, shift = chance.normal(size=(3, width)).astype(np.float32)
    vectors = [shared_array(vector, wp.float32) for vector in (scale, shift)]

    def wanted(rows: np.ndarray) -> np.ndarray:
        rectified = torch.from_numpy(rows).double().clamp_min(0)
        weight, bias = (torch.from_numpy(vector).double() for vector in (scale, shift))
        return layer_norm(rectified, (width,), weight, bias, 1e-3).numpy()

    found = values.copy()
    Recorded(rectify_and_normalise, ROWS, *vectors, 1e-3, shared_array(found, wp.float32, 2))()
    np.testing.assert_allclose(found, wanted(values), atol=1e-5)
    found = values.copy()
    given = shared_array(common, wp.float32), shared_array(own, wp.float32, 2), *vectors
    Recorded(add_rectify_and_normalise, ROWS, *given, 1e-3, shared_array(found, wp.float32, 2))()
    np.testing.assert_allclose(found, wanted(values + common + own), atol=1e-5)
