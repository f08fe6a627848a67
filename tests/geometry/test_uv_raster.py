"""An atlas on pixels: areas, interpolation and half pixels are exact; overlaps are refused."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.geometry.uv_raster import overlapping_faces, pixel_centres, rasterise

SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("size", [1, 7, 64])
def test_a_full_square_covers_every_pixel_once(size):
    raster = rasterise(SQUARE, HALVES, size)
    np.testing.assert_array_equal(raster.pixel, np.arange(size * size))
    np.testing.assert_allclose(raster.barycentric.sum(1), 1, atol=1e-6)


def test_interpolated_coordinates_are_the_pixel_centres(rng):
    corners = np.array([[0.1, 0.15], [0.9, 0.2], [0.4, 0.95]], np.float32)
    raster = rasterise(corners, np.array([[0, 1, 2]]), 50)
    np.testing.assert_allclose(raster.barycentric @ corners, pixel_centres(raster.pixel, 50), atol=1e-6)


def test_torch_samples_a_pixel_at_its_centre(rng):
    """The half-pixel convention is that of grid_sample with align_corners=False, exactly."""
    image = torch.from_numpy(rng.normal(size=(1, 2, 9, 9)))
    centres = torch.from_numpy(2 * pixel_centres(np.arange(81), 9) - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(image, centres, align_corners=False)
    torch.testing.assert_close(sampled[0, :, 0], image[0].flatten(1))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_covered_pixels_are_those_inside_of_any_triangle(seed):
    corners = np.random.default_rng(seed).random((3, 2)).astype(np.float32)
    raster = rasterise(corners, np.array([[0, 1, 2]]), 32)
    centres = pixel_centres(np.arange(32 * 32), 32)
    a, b, c = corners.astype(float)
    sides = [(q - p)[0] * (centres - p)[:, 1] - (q - p)[1] * (centres - p)[:, 0] for p, q in ((a, b), (b, c), (c, a))]
    clear = np.abs(sides).min(0) > 1e-6  # a centre on a side may fall either way
    inside = (np.sign(sides) == np.sign(sides[0])).all(0)
    got = np.isin(np.arange(32 * 32), raster.pixel)
    np.testing.assert_array_equal(got[clear], inside[clear])


def test_area_is_approached_under_refinement():
    corners = np.array([[0.12, 0.05], [0.93, 0.31], [0.37, 0.88]], np.float32)
    area = 0.5 * abs(np.linalg.det(corners[1:] - corners[0]))
    errors = [abs(len(rasterise(corners, np.array([[0, 1, 2]]), n).pixel) / n**2 - area) for n in (16, 64, 256)]
    assert errors[2] < 0.25 * errors[0]
    assert errors[2] < 1e-3


def test_the_body_that_ships_has_an_atlas(body):
    uv, faces = body.uv.numpy(), body.uv_faces.numpy()
    assert len(overlapping_faces(uv, faces)) == 0
    raster = rasterise(uv, faces, 256)
    assert len(raster.pixel) == pytest.approx(40_898, rel=0.01)  # facts.md 3


def test_overlaps_are_found_however_small():
    """A triangle of a 3,000th of the square on another: far below a pixel."""
    small = np.array([[0.5, 0.4], [0.5003, 0.4], [0.5, 0.4003]], np.float32)
    uv = np.concatenate([SQUARE, small])
    faces = np.array([*HALVES, [4, 5, 6]])
    np.testing.assert_array_equal(overlapping_faces(uv, faces), [[0, 2]])
    with pytest.raises(ValueError, match=r"the atlas overlaps itself: 1 pairs .*first: faces 0 and 2"):
        rasterise(uv, faces, 16)


def test_neighbours_that_share_a_side_or_corner_do_not_overlap():
    n = 20
    i, j = np.meshgrid(np.arange(n), np.arange(n))
    corner = (i + (n + 1) * j).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n + 2], 1), np.stack([corner, corner + n + 2, corner + n + 1], 1)]
    )
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    uv = np.stack([x.ravel(), y.ravel()], 1).astype(np.float32)
    assert len(overlapping_faces(uv, faces)) == 0
    assert len(overlapping_faces(uv, faces[:, ::-1])) == 0  # mirrored charts are charts too


def test_coordinates_outside_of_the_square_are_refused():
    with pytest.raises(ValueError, match=r"run from 0 to 2.*pack all charts"):
        rasterise(2 * SQUARE, HALVES, 8)
    with pytest.raises(ValueError, match="1 texture coordinates are NaN"):
        rasterise(np.array([[0, 0], [1, np.nan], [1, 1], [0, 1]], np.float32), HALVES, 8)
