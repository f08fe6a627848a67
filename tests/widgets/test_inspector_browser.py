"""The inspector's page in a real browser: a click on a cell shows its frame, its region, its worst vertex; offline."""

import json
import shutil

import pytest
import torch
from playwright.sync_api import sync_playwright

from workbench.collisions.planting import Plant, planted
from workbench.collisions.sequences import shipped_sequence
from workbench.formats.mesh_sequence import DressedSequence, MeshSequence, write_dressed_sequence
from workbench.geometry.mesh import unique_edges
from workbench.inspector import InspectConfig, run

pytestmark = pytest.mark.browser
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox")


@pytest.fixture(scope="module")
def report(body, tmp_path_factory):
    """The folder of a report on a walk with one dent in frames 3 and 4."""
    from widgets.inspector_view import write_inspection

    folder = tmp_path_factory.mktemp("inspector")
    sequence = shipped_sequence("tshirt_walk").clip(0, 6)
    with torch.no_grad():
        surface = body.vertices(sequence.rotations, sequence.betas, sequence.translation)
    garment = planted(sequence.garment, unique_edges(sequence.faces), surface, body.faces, [Plant(3796, 3, 4)])
    brought = DressedSequence(
        MeshSequence(surface.numpy(), body.faces.numpy(), 30.0, "body"),
        MeshSequence(garment.numpy(), sequence.faces.numpy(), 30.0, "garment"),
    )
    write_dressed_sequence(folder / "walk.npz", brought)
    run(InspectConfig(folder / "walk.npz", out=folder), page=write_inspection)
    return folder


@pytest.fixture
def page(report):
    chromium = shutil.which("chromium")
    if chromium is None:  # .ci/run installs it, so there the tests run
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(SOFTWARE_GL))
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        troubles: list[str] = []
        page.on("console", lambda said: troubles.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda asked: troubles.append(asked.url) if asked.url.startswith("http") else None)
        page.goto((report / "report.html").as_uri())
        page.wait_for_function("window.workbenchView", timeout=60_000)
        yield page
        assert troubles == []
        browser.close()


def test_a_cell_shows_its_frame_region_and_depth(page, report):
    figures = json.loads((report / "report.json").read_text())
    before = page.evaluate("workbenchView.png()")
    page.click('#heat .cell[data-f="4"]')
    page.wait_for_timeout(500)
    assert page.evaluate("workbenchView.frame()") == 4
    told = page.inner_text("#told")
    assert told.startswith("belly, frame 4 (0.13 s): ")
    assert f"{figures['per_frame']['deepest_mm'][4]:.2f} mm" in told
    assert page.evaluate("workbenchView.png()") != before
    assert [select.input_value() for select in page.query_selector_all('select[title="isolate a region"]')] == [
        "belly"
    ] * 2
    page.click("#all")
    assert [select.input_value() for select in page.query_selector_all('select[title="isolate a region"]')] == [""] * 2


def test_an_incident_is_picked(page, report):
    incident = json.loads((report / "report.json").read_text())["incidents"][0]
    page.click("#charts tr.go")
    page.wait_for_timeout(500)
    read = page.inner_text(".wbv-read")
    assert "garment, vertex 3796" in read
    assert f"{incident['depth_mm']:.2f} mm" in read
    assert page.evaluate("workbenchView.frame()") == incident["worst_frame"]
