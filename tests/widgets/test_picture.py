"""Pictures: what lies in the scene is seen, from any thread; a machine that cannot draw says how to mend it."""

import threading

import numpy as np
import pytest
import trimesh
from PIL import Image

from widgets import gl
from widgets.gl import CannotDraw
from widgets.picture import picture, write_picture
from widgets.scene import Arrows, Mesh, Points, Scalars, Scene, View

SIZE = (120, 120)
BALL = trimesh.creation.icosphere(3, radius=0.5)
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)
RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)

needs_gl = pytest.mark.skipif(bool(gl.fault()), reason=f"this machine cannot draw: {gl.GL_COMMAND}")


def shows(pixels, colour):
    """Share of pixels in which the one channel of `colour` stands out."""
    channel = int(np.argmax(colour))
    others = np.delete(pixels.astype(int), channel, axis=-1).max(-1)
    return float((pixels[..., channel].astype(int) - others > 60).mean())


@needs_gl
def test_ball_is_in_the_middle_on_a_light_background():
    pixels = picture(Scene((View((Mesh(VERTICES, FACES, RED),)),)), SIZE)
    assert pixels.shape == (120, 120, 3)
    assert 0.4 < shows(pixels, RED) < 0.8
    assert pixels[:6, :6].min() > 200
    rows, columns = np.nonzero(pixels[..., 0].astype(int) - pixels[..., 1] > 60)
    assert abs(rows.mean() - 60) < 3
    assert abs(columns.mean() - 60) < 3


@needs_gl
def test_views_side_by_side_are_lit_alike():
    view = View((Mesh(VERTICES, FACES, RED),))
    alone = picture(Scene((view,)), SIZE)
    triple = picture(Scene((view, view, view)), (360, 120))
    for column in range(3):
        assert np.abs(triple[:, 120 * column : 120 * (column + 1)].astype(int) - alone).mean() < 3


@needs_gl
def test_views_fill_a_grid_row_by_row():
    red, green = View((Mesh(VERTICES, FACES, RED),)), View((Mesh(VERTICES, FACES, GREEN),))
    pixels = picture(Scene((red, green, green), columns=2), (240, 240))
    assert shows(pixels[:120, :120], RED) > 0.3
    assert shows(pixels[:120, 120:], GREEN) > 0.3
    assert shows(pixels[120:, :120], GREEN) > 0.3
    assert pixels[130:, 130:].min() > 200


@needs_gl
def test_points_inside_are_seen_only_on_top():
    ball = Mesh(VERTICES, FACES, RED)
    hidden = Points(np.zeros((1, 3)), GREEN, size=20.0)
    shown = Points(np.zeros((1, 3)), GREEN, size=20.0, on_top=True)
    assert shows(picture(Scene((View((ball, hidden)),)), SIZE), GREEN) == 0
    assert shows(picture(Scene((View((ball, shown)),)), SIZE), GREEN) > 0.005


@needs_gl
def test_any_thread_draws_the_same():
    scene, drawn = Scene((View((Mesh(VERTICES, FACES, RED),)),)), []
    threads = [threading.Thread(target=lambda: drawn.append(picture(scene, SIZE))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    here = picture(scene, SIZE)
    assert here.std() > 10
    assert len(drawn) == 3
    assert all(np.array_equal(pixels, here) for pixels in drawn)


@needs_gl
def test_scalars_colour_the_surface_and_arrows_are_drawn():
    height = Scalars(VERTICES[:, 2], "height", "m", limits=(-0.5, 0.5), colour_map="coolwarm")
    pixels = picture(Scene((View((Mesh(VERTICES, FACES, scalars=height),), "title"),)), (240, 240))
    reddish = pixels[..., 0].astype(int) - pixels[..., 2] > 60
    assert reddish[:110].sum() > 500
    assert reddish[130:200].sum() == 0
    arrows = Arrows(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), RED)
    assert shows(picture(Scene((View((arrows,)),)), SIZE), RED) > 0.01


@needs_gl
def test_png_is_written_whole(tmp_path):
    path = write_picture(tmp_path / "a" / "b.png", Scene((View((Mesh(VERTICES, FACES),)),)), SIZE)
    with Image.open(path) as image:
        assert image.size == SIZE
    assert [p.name for p in path.parent.iterdir()] == ["b.png"]


def test_nothing_to_draw_is_told(tmp_path):
    scene = Scene((View((Points(np.eye(3)),)),))
    with pytest.raises(ValueError, match="the scene has no view"):
        picture(Scene(()))
    with pytest.raises(ValueError, match="8 x 8 pixels is too small"):
        picture(scene, (8, 8))
    with pytest.raises(ValueError, match=r"written as \.png, not as a\.jpg"):
        write_picture(tmp_path / "a.jpg", scene)


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", r"ended its process \(signal 11\)"),
        ("raise SystemExit(3)", "stayed empty"),
        ("raise RuntimeError('no EGL')", "failed: RuntimeError: no EGL"),
        ("import time; time.sleep(9)", "took longer than 0.2 s"),
    ],
)
def test_machine_that_cannot_draw_names_the_command(monkeypatch, code, told):
    monkeypatch.setattr(gl, "PROBE", code)
    if "sleep" in code:
        monkeypatch.setattr(gl, "PATIENCE", 0.2)
    gl.fault.cache_clear()
    try:
        with pytest.raises(CannotDraw, match=rf"this machine cannot draw \(.*{told}.*\): run apt-get install"):
            picture(Scene((View((Points(np.eye(3)),)),)), SIZE)
    finally:
        gl.fault.cache_clear()
