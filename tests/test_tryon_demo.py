"""`workbench demo` with the model that ships, on a short motion."""

import json

import numpy as np
import pytest

from widgets.scene import Mesh
from widgets.tryon_view import moving, strip
from workbench.formats import load_motion, motion_files
from workbench.tryon_demo import TryOnDemoConfig, dress, run


@pytest.fixture(scope="module")
def demo(body, tmp_path_factory):
    path = tmp_path_factory.mktemp("motion") / "short.npz"
    load_motion(motion_files(None)[0], body).clip(0, 8).save(path)
    return dress(TryOnDemoConfig(motion=str(path), clear=False))


def test_the_report_says_what_was_counted(demo):
    share = demo.report["collisions_percent"]["posed"]["inside"]
    assert share == pytest.approx(100 * float(demo.posed.inside.float().mean()))
    assert demo.report["frames"] == 8 == len(demo.result.garment)
    assert demo.report["betas"][:4] == [0.8, -1.0, -1.2, 0.6]


def test_files_are_written_and_drawing_is_asked_for(demo, tmp_path, body):
    asked = []
    motion = tmp_path / "short.npz"
    load_motion(motion_files(None)[0], body).clip(0, 3).save(motion)

    def draw(demo, path):
        asked.append(path.name)
        return path

    run(TryOnDemoConfig(out=tmp_path / "out", motion=str(motion), clear=False), picture=draw, page=draw)
    assert asked == ["tryon.png", "tryon.html"]
    assert json.loads((tmp_path / "out" / "report.json").read_text())["frames"] == 3
    assert (tmp_path / "out" / "tryon.glb").read_bytes()[:4] == b"glTF"


def test_the_strip_pairs_posed_and_canonical(demo):
    scene = strip(demo, columns=3)
    assert (scene.columns, len(scene.views)) == (3, 6)
    assert [view.title.split(":")[0] for view in scene.views[3:]] == ["canonical"] * 3


def test_the_page_shows_the_body_where_it_stands(demo):
    scene = moving(demo)
    body = scene.views[0].layers[0]
    assert isinstance(body, Mesh)
    middle = (body.vertices.min(1) + body.vertices.max(1)) / 2
    np.testing.assert_allclose(middle[:, :2], 0, atol=1e-4)


def test_a_motion_that_does_not_ship_is_named():
    with pytest.raises(ValueError, match="no motion 'fly' ships; there are: test_"):
        dress(TryOnDemoConfig(motion="fly"))
