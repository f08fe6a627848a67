# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false
"""Laws of assets_gen.cloth_solver that need no simulation; those that do are in test_simulations."""

import numpy as np
import pytest
import trimesh

from assets_gen.cloth_solver import ClothSolver, flat_panels, require_outside


def test_panels_keep_every_triangle_and_lay_it_flat(rng):
    rest, faces = rng.normal(size=(30, 3)), rng.permutation(30).reshape(10, 3)
    flat = flat_panels(rest, faces).reshape(-1, 3, 2)
    for corners, triangle in zip(flat, rest[faces], strict=True):
        for i in range(3):
            side = np.linalg.norm(triangle[i] - triangle[i - 1])
            assert np.linalg.norm(corners[i] - corners[i - 1]) == pytest.approx(side, rel=1e-9)
        first, second = corners[1] - corners[0], corners[2] - corners[0]
        assert first[0] * second[1] - first[1] * second[0] > 0  # Newton drops panels that are turned over


def test_cloth_that_starts_inside_the_body_is_refused():
    ball = trimesh.creation.icosphere(2, 0.3)
    require_outside(np.asarray(ball.vertices * 1.1, np.float32), ball.vertices, ball.faces)
    sunk = np.asarray(ball.vertices * 1.1, np.float32) + np.float32([0, 0, 0.06])
    with pytest.raises(ValueError, match=r"\d+ of 162 garment vertices are inside the body at frame 0") as caught:
        ClothSolver(ball.vertices, ball.faces, sunk, ball.faces)
    assert "\n" not in str(caught.value)
