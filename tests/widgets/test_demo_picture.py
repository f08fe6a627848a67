"""The demo's picture: three places side by side, a row a frame, the walk taken out; without GL it is left out aloud."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from widgets import demo_picture
from widgets.demo_picture import demo_scene, draw_demo
from widgets.gl import CannotDraw
from widgets.scene import Mesh, Points
from workbench.collisions.penetration import Penetration
from workbench.demo import DemoResult, DressedBody

FRAMES = 9


@pytest.fixture
def result():
    ball = trimesh.creation.icosphere(1)
    vertices, faces = torch.tensor(ball.vertices).float(), torch.tensor(ball.faces)
    walk = torch.arange(FRAMES)[:, None, None] * torch.tensor([0.0, -5.0, 0.0])
    body, garment = vertices + walk, 1.1 * vertices + walk
    inside = torch.zeros(FRAMES, len(vertices), dtype=torch.bool)
    clean, colliding = Penetration(inside, inside), Penetration(~inside, inside)
    return DemoResult(
        DressedBody(body, garment, clean),
        DressedBody(vertices[None], (1.1 * vertices).expand(FRAMES, -1, -1), clean),
        DressedBody(body, garment, colliding),
        torch.ones(FRAMES, dtype=torch.bool),
        faces,
        faces,
        30.0,
        {},
    )


def test_three_columns_with_a_row_a_frame(result):
    scene = demo_scene(result)
    assert scene.columns == 3
    assert len(scene.views) == 9
    titles = [view.title for view in scene.views]
    assert titles[:3] == [
        "simulated, frame 1: 0 inside",
        "canonical, frame 1: 0 inside",
        "another shape, frame 1: 42 inside",
    ]
    for view in scene.at(0).views:
        assert isinstance(view.layers[-1], Points) == view.title.startswith("another")
        for layer in view.layers:
            if isinstance(layer, Mesh):
                np.testing.assert_allclose(layer.vertices.mean(0), 0, atol=1e-5)


def test_short_motion_has_fewer_rows(result):

    def first(place):
        collisions = Penetration(place.collisions.inside[:1], place.collisions.overlap[:1])
        return DressedBody(place.body[:1], place.garment[:1], collisions)

    short = replace(
        result,
        simulated=first(result.simulated),
        canonical=first(result.canonical),
        reposed=first(result.reposed),
        valid=result.valid[:1],
    )
    assert len(demo_scene(short).views) == 3


def test_machine_that_cannot_draw_leaves_the_picture_out_aloud(result, tmp_path, monkeypatch, caplog):
    def refuse(path, scene, size):
        raise CannotDraw("this machine cannot draw (no GL): run apt-get install -y libgl1")

    monkeypatch.setattr(demo_picture, "write_picture", refuse)
    with caplog.at_level(logging.WARNING):
        draw_demo(result, tmp_path / "tryon.png")
    assert caplog.messages == ["tryon.png is left out: this machine cannot draw (no GL): run apt-get install -y libgl1"]
    assert not (tmp_path / "tryon.png").exists()
