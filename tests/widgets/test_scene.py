"""Scenes: cameras see everything, colliding vertices get a layer of their own."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from widgets.scene import Arrows, Mesh, Points, Scalars, Scene, View, camera_of, dressed, ghosted, positions_of

FACES = np.array([[0, 1, 2]])


def seen(points, camera, aspect=1.0):
    """Where points fall in the picture, -1 to 1 both ways."""
    position, target = np.array(camera.position), np.array(camera.target)
    towards = (target - position) / np.linalg.norm(target - position)
    right = np.cross(towards, camera.up)
    right /= np.linalg.norm(right)
    depth = (points - position) @ towards
    slope = np.tan(np.radians(camera.view_angle) / 2)
    across = (points - position) @ right / (depth * slope * aspect)
    return depth, across, (points - position) @ np.cross(right, towards) / (depth * slope)


@settings(deadline=None)
@given(
    seed=st.integers(0, 1000),
    direction=st.sampled_from([(0.2, -1.0, 0.1), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-0.5, 0.5, -0.4)]),
    aspect=st.sampled_from([0.4, 1.0, 2.5]),
    scale=st.sampled_from([0.01, 1.0, 300.0]),
)
def test_camera_sees_every_point_and_fills_the_picture(seed, direction, aspect, scale):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * rng.uniform(0.1, 1, 3) * scale + rng.normal(size=3) * 5
    depth, across, up = seen(points, camera_of([Points(points)], direction, aspect=aspect), aspect)
    assert (depth > 0).all()
    extent = max(np.abs(across).max(), np.abs(up).max())
    assert extent <= 1.0
    assert extent > 0.3


def test_camera_ignores_what_is_not_finite():
    points = np.array([[0.0, 0, 0], [1, 1, 1], [np.nan, 0, 0], [np.inf, 0, 0]])
    assert camera_of([Points(points)]) == camera_of([Points(points[:2])])


def test_empty_scene_is_told():
    with pytest.raises(ValueError, match="there is nothing to look at"):
        camera_of([])
    with pytest.raises(ValueError, match="there is nothing to look at"):
        Scene((View((Points(np.zeros((0, 3))),)),)).resolved_camera()


def test_given_camera_is_kept():
    camera = camera_of([Points(np.eye(3))])
    assert Scene((), camera=camera).resolved_camera() == camera


def test_colliding_vertices_are_drawn_on_top(rng):
    body, garment = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    inside = np.array([True, False, True])
    scene = Scene((dressed(body, FACES, garment, FACES, inside),))
    top = scene.at(0).views[0].layers[-1]
    assert isinstance(top, Points)
    assert top.on_top
    np.testing.assert_array_equal(top.positions, garment[inside])
    clean = Scene((dressed(body, FACES, garment, FACES, np.zeros(3, bool)),))
    assert len(clean.at(0).views[0].layers) == 2


def test_ghost_keeps_all_but_the_surfaces(rng):
    vertices = rng.normal(size=(3, 3))
    view = ghosted(View((Mesh(vertices, FACES), Points(vertices))), 0.2)
    assert isinstance(view.layers[0], Mesh)
    assert view.layers[0].opacity == 0.2
    assert isinstance(view.layers[1], Points)


def test_arrows_cover_their_tips(rng):
    starts, vectors = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    np.testing.assert_array_equal(positions_of(Arrows(starts, vectors)), np.concatenate([starts, starts + vectors]))


def test_scalar_range_ignores_nan_and_takes_given_limits():
    values = np.array([1.0, np.nan, 3.0])
    assert Scalars(values, "depth").range() == (1.0, 3.0)
    assert Scalars(values, "depth", limits=(0.0, 9.0)).range() == (0.0, 9.0)
    assert Scalars(values[1:2], "depth").range() == (0.0, 1.0)
