"""Pages in a real browser: one file, nothing from a network, small; without WebGL they say what to do."""

import re

import numpy as np
import pytest
import torch
import trimesh

from widgets.page import write_page
from widgets.scene import Mesh, Scene, View, dressed
from workbench.collisions.sequences import shipped_sequence

pytestmark = pytest.mark.browser
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
VERTICES, FACES = np.asarray(BALL.vertices, np.float32), np.asarray(BALL.faces)
MOST = 8e6  # bytes of a try-on of 120 frames
READY = "window.workbenchView || document.querySelector('.wbv-fault')"


def test_a_try_on_of_120_frames_is_one_small_file_that_plays(body, open_file, tmp_path):
    sequence = shipped_sequence("tshirt_demo")
    there_and_back = torch.cat([torch.arange(len(sequence)), torch.arange(len(sequence)).flip(0)])[:120]
    with torch.no_grad():
        bodies = body.vertices(sequence.rotations, sequence.betas, sequence.translation)[there_and_back]
    scene = Scene(
        (
            dressed(
                bodies.numpy(),
                body.faces.numpy(),
                sequence.garment[there_and_back].numpy(),
                sequence.faces.numpy(),
                np.zeros((120, sequence.garment.shape[1]), bool),
            ),
        )
    )
    path = write_page(tmp_path / "tryon.html", scene)
    assert path.stat().st_size <= MOST
    assert [child.name for child in tmp_path.iterdir() if child.is_file()] == ["tryon.html"]
    page = open_file(path)  # fails on any request beyond the file
    page.wait_for_function(READY, timeout=60_000)
    first = page.evaluate("workbenchView.png()")
    page.evaluate("workbenchView.play()")
    page.wait_for_function("workbenchView.frame() > 3", timeout=60_000)
    page.evaluate("workbenchView.pause()")
    assert page.evaluate("workbenchView.png()") != first
    read = page.evaluate("workbenchView.read('garment', 17)")
    frame = page.evaluate("workbenchView.frame()")
    np.testing.assert_allclose(read["position"], sequence.garment[there_and_back[frame], 17], atol=1e-4)


def test_without_webgl_the_page_says_what_to_do(shown_browser, tmp_path):
    page = shown_browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(write_page(tmp_path / "a.html", Scene((View((Mesh(VERTICES, FACES),)),))).as_uri())
    page.wait_for_selector(".wbv-fault", timeout=60_000)
    told = page.inner_text(".wbv-fault")
    assert "needs WebGL 2" in told
    assert re.search("current Firefox, Chrome, Edge or Safari, with hardware acceleration", told)
    page.close()
