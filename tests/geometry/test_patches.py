"""Laws of overlapping patches."""

import numpy as np
import pytest
import torch

from workbench.geometry.patches import Patches


def sheet(count: int = 900) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 0.6, 0.0])


@pytest.mark.parametrize(("count", "overlap"), [(1, 1.0), (7, 1.0), (24, 3.0), (900, 3.0), (5000, 3.0)])
def test_windows_sum_to_one_at_every_point(count, overlap):
    points = sheet()
    patches = Patches.of(points, count, overlap)
    assert len(patches) == min(count, len(points))
    assert patches.point_count == len(points)
    ones = torch.ones(*patches.vertices.shape, 1)
    torch.testing.assert_close(patches.spread(ones), torch.ones(len(points), 1))


def test_a_function_of_the_points_comes_back_from_its_patches():
    points = sheet()
    patches = Patches.of(points, 12)
    values = torch.stack([points.sin().sum(1), points[:, 0]], dim=1)
    torch.testing.assert_close(patches.spread(values[patches.vertices]), values)
    batch = torch.stack([values, 2 * values])[:, patches.vertices]
    torch.testing.assert_close(patches.spread(batch)[1], 2 * values)


def test_the_matrix_does_the_same():
    patches = Patches.of(sheet(), 12)
    values = torch.randn(*patches.vertices.shape, 3, generator=torch.Generator().manual_seed(1))
    np.testing.assert_allclose(patches.matrix @ values.reshape(-1, 3).numpy(), patches.spread(values), atol=1e-6)


def test_a_patch_ends_without_a_step():
    """The jump that a patch's own value makes from a point to its neighbour, inside or out, shrinks with refinement."""
    jumps = []
    for side in (20, 40, 80):
        axis = torch.linspace(0, 1, side)
        points = torch.stack([*torch.meshgrid(axis, axis, indexing="ij"), torch.zeros(side, side)], dim=-1)
        patches = Patches.of(points.reshape(-1, 3), 9)
        one = torch.zeros(*patches.vertices.shape, 1)
        one[4] = 1.0
        spread = patches.spread(one).reshape(side, side)
        jumps.append(float(torch.maximum(spread.diff(dim=0).abs().max(), spread.diff(dim=1).abs().max())))
    assert jumps[0] > 1.6 * jumps[1] > 2.56 * jumps[2]


def test_what_cannot_be_patches_is_refused():
    patches = Patches.of(sheet(), 12)
    entries = patches.vertices.numel()
    assert patches.checked(entries) is patches
    for wrong, count in (
        (patches, entries + 1),
        (Patches(patches.vertices - 1, patches.windows), entries),
        (Patches(patches.vertices + 1, patches.windows), entries),
        (Patches(patches.vertices, patches.windows * float("inf")), entries),
    ):
        with pytest.raises(ValueError, match="^patches "):
            wrong.checked(count)
