"""A mesh's atlas on a grid of pixels: texture coordinates (U,2), faces (F,3) -> the surface point of every pixel.

The pixel of row i and column j of an n x n map is the square whose centre has u = (j + 1/2) / n, v = (i + 1/2) / n:
what `torch.nn.functional.grid_sample` calls align_corners=False.  Coordinates lie in [0, 1].
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

INSIDE = -1e-9  # least barycentric coordinate of a centre that counts as in a triangle: shared edges leave no hole
TOUCH = 1e-6  # depth, in sides of the square, by which triangles may overlap: coordinates are float32
CELLS = 256  # of the grid in which overlapping triangles are looked for


@dataclass(frozen=True)
class UVRaster:
    """Where the N covered pixels of a map lie on the mesh, row by row."""

    size: int  # pixels a side
    pixel: Int[np.ndarray, "N"]  # row * size + column
    face: Int[np.ndarray, "N"]
    barycentric: Float[np.ndarray, "N 3"]


def pixel_centres(pixel: Int[np.ndarray, "N"], size: int) -> Float[np.ndarray, "N 2"]:
    """(u, v) of pixels given as row * size + column."""
    return np.stack([pixel % size + 0.5, pixel // size + 0.5], 1) / size


def rasterise(uv: Float[np.ndarray, "U 2"], uv_faces: Int[np.ndarray, "F 3"], size: int) -> UVRaster:
    """The face and barycentric coordinates at the centre of every covered pixel; of a shared edge the first face.

    Raises:
        ValueError: coordinates that are not finite or leave the unit square, or triangles that overlap.
    """
    require_atlas(uv, uv_faces)
    corners = uv[uv_faces].astype(np.float64)
    low = np.clip(np.ceil(corners.min(1) * size - 0.5), 0, size - 1).astype(np.int64)
    high = np.clip(np.floor(corners.max(1) * size - 0.5), -1, size - 1).astype(np.int64)
    span = np.maximum(high - low + 1, 0)
    count = span[:, 0] * span[:, 1]
    face = np.repeat(np.arange(len(corners)), count)
    within = np.arange(len(face)) - np.repeat(count.cumsum() - count, count)  # which pixel of its face's box
    column, row = low[face, 0] + within % span[face, 0], low[face, 1] + within // span[face, 0]
    pixel = row * size + column
    barycentric = barycentric_coordinates(pixel_centres(pixel, size), corners[face])
    hit = (barycentric >= INSIDE).all(1)
    pixel, first = np.unique(pixel[hit], return_index=True)  # faces ascend: the first is the lowest
    inside = np.clip(barycentric[hit][first], 0, None)
    return UVRaster(
        size=size,
        pixel=pixel,
        face=face[hit][first],
        barycentric=(inside / inside.sum(1, keepdims=True)).astype(np.float32),
    )


def barycentric_coordinates(
    points: Float[np.ndarray, "N 2"], corners: Float[np.ndarray, "N 3 2"]
) -> Float[np.ndarray, "N 3"]:
    """Of each point in its own triangle; -inf in one without area."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = _cross(b - points, c - points) / area, _cross(c - points, a - points) / area
    result = np.stack([first, second, 1 - first - second], 1)
    result[np.abs(area) < 1e-14] = -np.inf
    return result


def require_atlas(uv: Float[np.ndarray, "U 2"], uv_faces: Int[np.ndarray, "F 3"]) -> None:
    """Raises ValueError unless every point of the square belongs to at most one triangle."""
    if not np.isfinite(uv).all():
        raise ValueError(f"{int((~np.isfinite(uv)).any(1).sum())} texture coordinates are NaN or infinite")
    if uv.min() < -TOUCH or uv.max() > 1 + TOUCH:
        raise ValueError(
            f"texture coordinates run from {uv.min():.3g} to {uv.max():.3g}, but must lie in [0, 1]: "
            "pack all charts into one square first"
        )
    pairs = overlapping_faces(uv, uv_faces)
    if len(pairs):
        raise ValueError(
            f"the atlas overlaps itself: {len(pairs)} pairs of faces share texture (first: faces {pairs[0, 0]} and "
            f"{pairs[0, 1]}), so a pixel would belong to two places of the surface; unwrap the mesh without overlaps"
        )


def overlapping_faces(uv: Float[np.ndarray, "U 2"], uv_faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "P 2"]:
    """Pairs of faces that overlap by more than TOUCH (separating axes: exact, whatever the resolution of a map)."""
    corners = uv[uv_faces].astype(np.float64)
    corners = np.where((_cross(*_sides(corners)) < 0)[:, None, None], corners[:, ::-1], corners)  # counter-clockwise
    pairs = _neighbours(corners)
    one, two = corners[pairs[:, 0]], corners[pairs[:, 1]]
    return pairs[~(_separated(one, two) | _separated(two, one))]


def _separated(one: Float[np.ndarray, "P 3 2"], two: Float[np.ndarray, "P 3 2"]) -> np.ndarray:
    """A side of `one` has all of `two` beyond it; a triangle without area has nothing to overlap."""
    apart = np.abs(_cross(*_sides(one))) < TOUCH**2
    for side in range(3):
        start, along = one[:, side], one[:, (side + 1) % 3] - one[:, side]
        outward = np.stack([along[:, 1], -along[:, 0]], 1) / (np.linalg.norm(along, axis=1, keepdims=True) + 1e-30)
        apart |= ((two - start[:, None]) * outward[:, None]).sum(2).min(1) > -TOUCH
    return apart


def _neighbours(corners: Float[np.ndarray, "F 3 2"]) -> Int[np.ndarray, "P 2"]:
    """Pairs of faces whose bounding boxes share a cell of a grid and overlap, each once, the smaller index first."""
    low, high = corners.min(1), corners.max(1)
    first, last = (np.clip(edge * CELLS, 0, CELLS - 1).astype(np.int64) for edge in (low, high))
    span = last - first + 1
    count = span[:, 0] * span[:, 1]
    face = np.repeat(np.arange(len(corners)), count)
    within = np.arange(len(face)) - np.repeat(count.cumsum() - count, count)
    cell = (first[face, 1] + within // span[face, 0]) * CELLS + first[face, 0] + within % span[face, 0]
    order = np.lexsort([face, cell])
    face, cell = face[order], cell[order]
    found = []
    for step in range(1, int(np.bincount(cell).max())):  # the step-th next face in the same cell
        same = np.flatnonzero(cell[step:] == cell[:-step])
        one, two = face[same], face[same + step]
        close = ((low[one] < high[two] - TOUCH) & (low[two] < high[one] - TOUCH)).all(1)
        found.append(np.stack([one[close], two[close]], 1))
    return np.unique(np.concatenate(found), axis=0) if found else np.zeros((0, 2), np.int64)


def _sides(corners: Float[np.ndarray, "N 3 2"]) -> tuple[np.ndarray, np.ndarray]:
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
