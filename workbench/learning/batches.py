"""Batches by chance.  rows (N,...), a generator on the CPU -> row numbers (n), the same on every device."""

import torch
from jaxtyping import Int
from torch import Tensor


def random_rows(rows: Tensor, count: int, generator: torch.Generator) -> Int[Tensor, " n"]:
    """Numbers of `count` rows, drawn with repetition, where the rows are."""
    return torch.randint(len(rows), (count,), generator=generator).to(rows.device)
