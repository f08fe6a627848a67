"""Panels: the scene follows the controls; without widgets a picture, without GL a line, never an error."""

import base64
import io
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import widgets.live
from widgets import gl, panel
from widgets.controls import Button, Group, Number
from widgets.frontend_bundle import NotBundled
from widgets.panel import Panel, fitted
from widgets.scene import Points, Scene, View
from workbench.extras import MissingExtra

pytest.importorskip("ipywidgets")
needs_gl = pytest.mark.skipif(bool(gl.fault()), reason=f"this machine cannot draw: {gl.GL_COMMAND}")
WIDGET = "application/vnd.jupyter.widget-view+json"


def panel_of(height=0.0, **options):
    slider = Number("height", height, 0.0, 9.0)
    computed = []

    def scene():
        computed.append(slider.value)
        if slider.value > 8:
            raise ValueError("too high")
        return Scene((View((Points(np.eye(3) + slider.value, size=20.0, name="dots"),)),))

    made = Panel(
        (Group("", (slider, Button("jump", lambda: slider.set(5.0)))),),
        scene,
        lambda: f"height {slider.value:g}",
        title="test",
        size=(160, 120),
        **options,
    )
    return made, computed


def test_scene_and_readout_follow_the_controls():
    made, computed = panel_of()
    made["height"] = 2.0
    np.testing.assert_array_equal(made.layer("dots").positions, np.eye(3) + 2)
    assert made.readout == "height 2"
    assert made["height"] == 2.0
    made.press("jump")
    assert made.readout == "height 5"
    assert computed == [0.0, 2.0, 5.0]


def test_moves_that_are_held_are_followed_once():
    made, computed = panel_of()
    with made.held():
        made["height"] = 1.0
        made["height"] = 2.0
    assert computed == [0.0, 2.0]


def test_many_threads_end_at_the_last_value():
    made, computed = panel_of()
    threads = [threading.Thread(target=lambda v=v: made.__setitem__("height", v / 10)) for v in range(1, 40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made.readout == f"height {made['height']:g}"
    assert computed[-1] == made["height"]


def test_live_scene_follows_and_a_fault_leaves_what_was_seen(monkeypatch):
    made, _ = panel_of()
    box, told = made.box, []
    monkeypatch.setattr(made.live, "tell", told.append)
    made["height"] = 3.0
    assert made.live._shown is made.scene
    assert "height 3" in str([w.value for w in box.children[1].children if hasattr(w, "value")])
    before = made.scene
    with pytest.raises(ValueError, match="too high"):
        made["height"] = 8.5
    assert told == ["too high"]
    assert made.scene is before


def test_unknown_names_are_told():
    made, _ = panel_of()
    with pytest.raises(KeyError, match="there is no control 'width'; there are: height"):
        made["width"] = 1.0
    with pytest.raises(KeyError, match="view 0 has no layer 'cloth'; it has dots"):
        made.layer("cloth")
    with pytest.raises(KeyError, match="there is no button 'height'; there are: jump"):
        made.press("height")


def test_frames_that_are_not_there_are_told():
    made, _ = panel_of()
    with pytest.raises(ValueError, match="no frame 3"):
        made.frame = 3


@needs_gl
def test_a_display_holds_the_widget_a_picture_and_words():
    made, _ = panel_of()
    bundle = made._repr_mimebundle_()
    assert WIDGET in bundle
    assert bundle["text/plain"] == "test; height 0"
    with Image.open(io.BytesIO(base64.b64decode(bundle["image/png"]))) as image:
        assert image.size == (160, 120)
        assert np.asarray(image).std() > 1


@needs_gl
def test_a_plot_stands_beside_the_scene():
    red = np.array([250, 0, 0], np.uint8)
    made, _ = panel_of(plot=lambda size, frame: np.tile(red, (size[1], size[0], 1)))
    pixels = made.picture((200, 120))
    assert pixels.shape == (120, 200, 3)
    assert (pixels[:, -84:] == red).all()
    assert made.picture().shape == (120, 276, 3)  # the scene keeps its width
    assert not (pixels[:, :100] == red).all(-1).any()
    assert WIDGET in made._repr_mimebundle_()


@needs_gl
@pytest.mark.parametrize("lacking", ["bundle", "anywidget", "ipywidgets"])
def test_without_widgets_there_is_a_picture(monkeypatch, lacking):
    if lacking == "bundle":

        def refused(_):
            raise NotBundled("run bundle.py")

        monkeypatch.setattr(widgets.live, "bundled", refused)
        wanted, kind = "not live: run bundle.py", NotBundled
    else:
        monkeypatch.setitem(sys.modules, lacking, None)
        if lacking == "anywidget":
            monkeypatch.delitem(sys.modules, "widgets.live")
        wanted, kind = f"'{lacking}', which is not installed: run pip install", MissingExtra
    made, _ = panel_of()
    made["height"] = 2.0
    bundle = made._repr_mimebundle_()
    assert WIDGET not in bundle
    assert "image/png" in bundle
    assert wanted in bundle["text/plain"]
    if lacking != "ipywidgets":
        with pytest.raises(kind):
            _ = made.live


@pytest.mark.parametrize("size", [(160, 120), (320, 120), (80, 120), (60, 120)])
def test_a_narrower_picture_is_taken_from_farther_away(size):
    made, _ = panel_of()
    scene = replace(made.scene, camera=made.scene.resolved_camera(160 / 120))
    seen = fitted(scene, (160, 120), size)
    assert scene.camera is not None and seen.camera is not None
    distances = [np.linalg.norm(np.subtract(c.position, c.target)) for c in (scene.camera, seen.camera)]
    assert distances[1] / distances[0] == pytest.approx(max(1.0, 160 / size[0]))
    assert seen.camera.target == scene.camera.target


def test_where_nothing_can_draw_a_line_says_so(monkeypatch):
    def refused(*_):
        raise panel.CannotDraw("this machine cannot draw: run apt-get install libgl1")

    monkeypatch.setattr(panel, "picture", refused)
    made, _ = panel_of()
    bundle = made._repr_mimebundle_()
    assert "image/png" not in bundle
    assert bundle["text/plain"] == "test; height 0; this machine cannot draw: run apt-get install libgl1"


def test_page_is_written_with_what_is_told(tmp_path):
    made, _ = panel_of()
    assert "<title>test: height 0</title>" in made.page(tmp_path / "a.html").read_text()
