# pyright: reportArgumentType=false
"""Crossing surfaces: known cases, exact rational arithmetic as the judge, and what must cross does."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import trimesh

from workbench.geometry.crossings import SurfaceCrossing
from workbench.geometry.layer_count import LayerCount

SHEET = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32)
ONE = np.array([[0, 1, 2]])


def spike(tip: float) -> tuple[np.ndarray, np.ndarray]:
    """A thin closed tetrahedron from z = -1 up to `tip`."""
    vertices = np.array([[-0.1, -0.1, -1], [0.1, -0.1, -1], [0, 0.1, -1], [0, 0, tip]], np.float32)
    return vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def test_a_spike_through_a_face_is_seen_although_every_vertex_is_outside():
    found = SurfaceCrossing(*spike(0.5))(SHEET, ONE)
    assert not found.edges.any()
    assert found.pierced.tolist() == [True]
    assert found.faces.tolist() == [True]
    assert np.flatnonzero(found.poking).tolist() == [3]


def test_a_sheet_turned_over_pokes_the_other_end_unless_told():
    turned = ONE[:, ::-1].copy()
    assert np.flatnonzero(SurfaceCrossing(*spike(0.5))(SHEET, turned).poking).tolist() == [0, 1, 2]
    assert np.flatnonzero(SurfaceCrossing(*spike(0.5))(SHEET, turned, outwards=False).poking).tolist() == [3]


def test_a_spike_that_ends_below_is_not_seen():
    found = SurfaceCrossing(*spike(-0.01))(SHEET, ONE)
    assert not (found.faces.any() or found.poking.any())


def test_an_edge_straight_through_a_body_is_seen_although_both_ends_are_outside():
    ball = trimesh.creation.icosphere(subdivisions=2)
    long = np.array([[-2, 0.01, 0.02], [2, 0.01, 0.02], [0, 5, 0]], np.float32)
    found = SurfaceCrossing(np.asarray(ball.vertices), np.asarray(ball.faces))(long, ONE)
    assert found.edges.tolist() == [[True, False, False]]


def test_refit_moves_the_mesh():
    vertices, faces = spike(0.5)
    crossing = SurfaceCrossing(vertices, faces)
    crossing.refit(vertices - np.float32([0, 0, 1]))
    assert not crossing(SHEET, ONE).faces.any()


def crosses(segment, triangle) -> bool:
    """In exact rational arithmetic; general position."""
    s, t = ([Fraction(float(x)) for x in p] for p in segment)
    p, q, r = ([Fraction(float(x)) for x in p] for p in triangle)

    def volume(a, b, c, d):
        (x, y, z), (u, v, w), (i, j, k) = ([m - n for m, n in zip(e, a)] for e in (b, c, d))
        return x * (v * k - w * j) - y * (u * k - w * i) + z * (u * j - v * i)

    apart = (volume(p, q, r, s) > 0) != (volume(p, q, r, t) > 0)
    around = {volume(s, t, p, q) > 0, volume(s, t, q, r) > 0, volume(s, t, r, p) > 0}
    return apart and len(around) == 1


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_exact_arithmetic_on_every_pair(seed):
    """Soups of large triangles on a coarse lattice, moved by single-precision crumbs: many near misses."""
    rng = np.random.default_rng(seed)

    def soup(count: int) -> np.ndarray:
        return (rng.integers(0, 6, (count, 3, 3)) / 4 + rng.normal(0, 3e-7, (count, 3, 3))).astype(np.float32)

    sheet, mesh = soup(25), soup(25)
    faces = np.arange(75).reshape(25, 3)
    found = SurfaceCrossing(mesh.reshape(-1, 3), faces)(sheet.reshape(-1, 3), faces)
    edges, pierced = np.zeros((25, 3), bool), np.zeros(25, bool)
    for g, f, side in product(range(25), range(25), range(3)):
        edges[g, side] |= crosses(sheet[g][[side, (side + 1) % 3]], mesh[f])
        pierced[g] |= crosses(mesh[f][[side, (side + 1) % 3]], sheet[g])
    assert edges.sum() > 10
    np.testing.assert_array_equal(found.edges, edges)
    np.testing.assert_array_equal(found.pierced, pierced)


def test_an_edge_between_different_layers_crosses(body, rng):
    """No crossing slips between faces: what is inside at one end and outside at the other crosses the body."""
    vertices, faces = body.template.numpy(), body.faces.numpy()
    starts = vertices[rng.choice(len(vertices), 2000)] + rng.normal(0, 0.004, (2000, 3))
    points = np.concatenate([starts, starts + rng.normal(0, 0.01, (2000, 3)), starts + 1e-4]).astype(np.float32)
    slivers = np.arange(6000).reshape(3, 2000).T.copy()
    layers = LayerCount(vertices, faces)(points)
    differ = layers[slivers] != layers[np.roll(slivers, -1, axis=1)]
    assert differ.sum() > 1000
    assert SurfaceCrossing(vertices, faces)(points, slivers).edges[differ].all()


def test_slivers_of_one_surface_share_their_crossings(body):
    """Both faces of an edge say the same of it."""
    vertices, faces = body.template.numpy(), body.faces.numpy()
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    sheet = (np.asarray(ball.vertices) + vertices.mean(0)).astype(np.float32)
    rims = np.asarray(ball.faces)
    found = SurfaceCrossing(vertices, faces)(sheet, rims).edges
    ends = np.sort(np.stack([rims, np.roll(rims, -1, axis=1)], -1), -1).reshape(-1, 2)
    order = np.lexsort(ends.T)
    pairs = found.reshape(-1)[order].reshape(-1, 2)
    assert pairs.any()
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])


def test_ties_are_consistent_with_the_layer_count():
    """Vertices on faces, edges and corners of a cube: an edge whose ends differ crosses; one along the lattice, shorter
    than the cube is thick, crosses only then."""
    box = trimesh.creation.box(extents=(2, 2, 2))
    mesh = np.asarray(box.vertices, np.float32), np.asarray(box.faces)
    grid = np.linspace(-1.5, 1.5, 7)
    points = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    step = np.array([0, 1, 7, 49])
    cells = np.arange(7**3).reshape(7, 7, 7)[:-1, :-1, :-1].reshape(-1, 1) + step
    sheet = cells[:, [[0, 1, 2], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    layers = LayerCount(*mesh)(points)
    differ = layers[sheet] != layers[np.roll(sheet, -1, axis=1)]
    found = SurfaceCrossing(*mesh)(points, sheet).edges
    assert found[differ].all()
    assert differ.sum() > 50
    straight = np.abs(points[sheet] - points[np.roll(sheet, -1, axis=1)]).sum(2) < 0.6
    np.testing.assert_array_equal(found[straight], differ[straight])
