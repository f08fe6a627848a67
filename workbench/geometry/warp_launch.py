"""Warp kernels called every frame.  array -> the same memory in Warp; kernel, arguments -> a repeatable call."""

from typing import Any

import numpy as np
import warp as wp


def shared_array(array: np.ndarray, dtype: Any, ndim: int = 1) -> wp.array:
    """Warp's view of the same memory."""
    return wp.array(array, dtype=dtype, ndim=ndim, device="cpu", copy=False)


class Recorded:
    """A launch that is repeated: a fifth of the cost of a new one.  Keeps its arrays alive."""

    def __init__(self, kernel: Any, dim: int, *inputs: Any):
        self.inputs = list(inputs)
        self.command: Any = wp.launch(
            kernel, dim=dim, inputs=self.inputs, device="cpu", record_tape=False, record_cmd=True
        )

    def __call__(self) -> None:
        self.command.launch()
