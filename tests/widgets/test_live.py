"""The live view's kernel side: a change sends what differs and no more; what goes wrong is told in the view."""

import numpy as np
import pytest
import trimesh

from widgets import gl, live, wire
from widgets.live import LiveScene
from widgets.scene import Mesh, Scene, View

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
VERTICES, FACES = np.asarray(BALL.vertices, np.float32), np.asarray(BALL.faces)
LOOK = {"position": [0, -3, 0], "target": [0, 0, 0], "up": [0, 0, 1], "angle": 24}


def scene(size: float = 1.0, other: float = 1.0) -> Scene:
    return Scene((View((Mesh(size * VERTICES, FACES, name="ball"), Mesh(other * VERTICES, FACES, name="other"))),))


@pytest.fixture
def shown(monkeypatch):
    """A view, and what it sends."""
    view, sent = LiveScene(scene()), []
    monkeypatch.setattr(view, "send", lambda message, buffers=None: sent.append((message, buffers)))
    return view, sent


def test_what_has_the_same_numbers_is_not_sent_again(shown):
    view, sent = shown
    view.renew(scene(2.0))  # a larger ball has the same whole numbers, only its header differs
    ((message, buffers),) = sent
    assert (message["keys"], buffers) == ([], [])
    assert message["header"]["views"][0]["layers"][0]["positions"]["low"] == [-1.0, -1.0, -1.0]


def test_of_a_mesh_that_bends_only_its_positions_are_sent(shown):
    view, sent = shown
    bent = VERTICES * np.array([1, 1, 2], np.float32)
    view.renew(Scene((View((Mesh(bent, FACES, name="ball"), Mesh(VERTICES, FACES, name="other"))),)))
    ((message, buffers),) = sent
    assert message["keys"] == ["0.0.positions"]
    assert len(buffers[0]) == 6 * len(VERTICES)


def test_a_view_that_opens_later_starts_from_what_is_current(shown):
    view, _ = shown
    late = scene(1.0, 3.0)
    view.renew(late)
    fresh = LiveScene(late)
    assert view.scene["header"] == fresh.scene["header"]
    assert view.scene["buffers"] == fresh.scene["buffers"]


def test_a_refused_scene_leaves_the_old_one_and_says_why(shown, monkeypatch):
    view, sent = shown
    before = dict(view.scene["buffers"])
    monkeypatch.setattr(wire, "LARGEST", 100)
    with pytest.raises(ValueError, match="MB for a browser"):
        view.renew(scene(2.0))
    ((message, _),) = sent
    assert message["kind"] == "fault"
    assert message["text"].startswith("Not shown: this scene is")
    assert view.scene["buffers"] == before


def test_a_kernel_that_cannot_draw_says_what_to_do(shown, monkeypatch):
    view, sent = shown
    monkeypatch.setattr(gl, "fault", lambda: "GL libraries are missing")
    view._answer(view, {"kind": "draw", "frame": 0, "camera": LOOK}, [])
    ((message, _),) = sent
    assert message["kind"] == "fault"
    assert gl.GL_COMMAND in message["text"]


def test_an_unforeseen_fault_of_drawing_is_told_and_not_swallowed(shown, monkeypatch):
    view, sent = shown

    def breaks(*_args, **_more):
        raise RuntimeError("the wires are crossed")

    monkeypatch.setattr(live, "picture", breaks)
    with pytest.raises(RuntimeError, match="crossed"):
        view._answer(view, {"kind": "draw", "frame": 0, "camera": LOOK}, [])
    assert sent[0][0] == {"kind": "fault", "text": "The kernel could not draw this: the wires are crossed"}


def test_other_messages_are_none_of_its_business(shown):
    view, sent = shown
    view._answer(view, {"kind": "hello"}, [])
    assert sent == []
