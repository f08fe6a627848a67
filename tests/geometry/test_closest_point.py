"""Closest points: against brute force, on a sphere, after a refit, and bad input."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.geometry.closest_point import ClosestPoint, morton_order, run_chunks


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def test_agrees_with_brute_force_over_all_faces(sphere, rng):
    vertices, faces = sphere
    points = rng.normal(size=(40, 3)).astype(np.float32)
    found = ClosestPoint(vertices, faces).query(points)
    nearest = trimesh.triangles.closest_point(
        np.repeat(vertices[faces][None], len(points), 0).reshape(-1, 3, 3), np.repeat(points, len(faces), 0)
    ).reshape(len(points), len(faces), 3)
    distance = np.linalg.norm(nearest - points[:, None], axis=2).min(1)
    np.testing.assert_allclose(found.distance, distance, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.point - points, axis=1), found.distance, atol=1e-6)


def test_barycentric_coordinates_rebuild_the_point(sphere, rng):
    vertices, faces = sphere
    found = ClosestPoint(vertices, faces).query(rng.normal(size=(3000, 3)).astype(np.float32))
    np.testing.assert_allclose(found.interpolate(vertices, faces), found.point, atol=1e-5)
    np.testing.assert_allclose(found.barycentric.sum(1), 1, atol=1e-5)
    assert found.barycentric.min() > -1e-5


def test_refit_is_as_good_as_a_new_mesh(sphere, rng):
    vertices, faces = sphere
    moved = (vertices * [1.0, 2.0, 0.5] + 3.0).astype(np.float32)
    points = rng.normal(size=(500, 3)).astype(np.float32) + 3
    closest = ClosestPoint(vertices, faces)
    closest.refit(moved)
    np.testing.assert_allclose(closest.query(points).distance, ClosestPoint(moved, faces).query(points).distance)
    with pytest.raises(ValueError, match="refit got 3 vertices"):
        closest.refit(moved[:3])


def test_order_and_threads_change_nothing(sphere, rng):
    vertices, faces = sphere
    points = rng.normal(size=(6000, 3)).astype(np.float32)
    closest = ClosestPoint(vertices, faces)
    one = closest.query(points)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        two = closest.query(points)
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(one.face, two.face)
    np.testing.assert_array_equal(one.distance, closest.query(points[::-1].copy()).distance[::-1])


def test_morton_order_is_a_permutation_that_keeps_neighbours(rng):
    points = rng.random((4096, 3)).astype(np.float32)
    order = morton_order(points)
    assert np.array_equal(np.sort(order), np.arange(4096))
    step = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    assert step < 0.3 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


def test_chunks_cover_every_index_once():
    seen = np.zeros(10_000, int)

    def work(start, stop):
        seen[start:stop] += 1

    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        run_chunks(work, len(seen))
    finally:
        torch.set_num_threads(threads)
    assert (seen == 1).all()


def test_no_points_are_no_trouble(sphere):
    assert len(ClosestPoint(*sphere).query(np.zeros((0, 3), np.float32)).face) == 0


def test_bad_input_is_named(sphere):
    vertices, faces = sphere
    closest = ClosestPoint(vertices, faces)
    with pytest.raises(ValueError, match=r"points must be finite, but row 1 is \[nan"):
        closest.query(np.array([[0, 0, 0], [np.nan, 0, 0]], np.float32))
    with pytest.raises(ValueError, match=r"faces index vertices 0 to 999, but the mesh has 642 vertices"):
        ClosestPoint(vertices, np.array([[0, 1, 999]]))
    with pytest.raises(ValueError, match="at least one triangle"):
        ClosestPoint(vertices, np.zeros((0, 3), int))
