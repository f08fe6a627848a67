"""A recorded launch works on the arrays it was given, as they are when it is called."""

import numpy as np
import warp as wp

from workbench.geometry.warp_kernels import closest_points  # noqa: F401  Warp is set up quietly there
from workbench.geometry.warp_launch import Recorded, shared_array


@wp.kernel
def doubled(source: wp.array(dtype=wp.float32), target: wp.array(dtype=wp.float32)):  # pyright: ignore
    i = wp.tid()
    target[i] = 2.0 * source[i]


def test_a_call_sees_what_the_arrays_hold_now():
    source, target = np.ones(3, np.float32), np.zeros(3, np.float32)
    call = Recorded(doubled, 3, shared_array(source, wp.float32), shared_array(target, wp.float32))
    assert target.tolist() == [0, 0, 0]
    call()
    assert target.tolist() == [2, 2, 2]
    source[:] = 5
    call()
    assert target.tolist() == [10, 10, 10]
