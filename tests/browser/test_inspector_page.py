"""The inspector's page in a real browser: a click on a cell shows its frame, its region, its worst vertex; offline."""

import json

import pytest
import torch
from playwright.sync_api import expect

from workbench.collisions.planting import Plant, planted
from workbench.collisions.sequences import shipped_sequence
from workbench.formats.mesh_sequence import DressedSequence, MeshSequence, write_dressed_sequence
from workbench.geometry.mesh import unique_edges
from workbench.inspector import InspectConfig, run

pytestmark = pytest.mark.browser


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
def page(report, open_file):
    page = open_file(report / "report.html")
    page.wait_for_function("window.workbenchView", timeout=60_000)
    return page


def test_a_cell_shows_its_frame_region_and_depth(page, report):
    figures = json.loads((report / "report.json").read_text())
    before = page.evaluate("workbenchView.png()")
    page.click('#heat .cell[data-f="4"]')
    expect(page.locator("body")).to_have_attribute("data-frame", "4")
    assert page.evaluate("workbenchView.frame()") == 4
    told = page.inner_text("#told")
    assert told.startswith("belly, frame 4 (0.13 s): ")
    assert f"{figures['per_frame']['deepest_mm'][4]:.2f} mm" in told
    assert page.evaluate("workbenchView.png()") != before
    assert page.inner_text(".wbv-count") == "4 / 5"
    assert [select.input_value() for select in page.query_selector_all('select[title="isolate a region"]')] == [
        "belly"
    ] * 2
    page.click("#all")
    assert [select.input_value() for select in page.query_selector_all('select[title="isolate a region"]')] == [""] * 2


def test_an_incident_is_picked(page, report):
    incident = json.loads((report / "report.json").read_text())["incidents"][0]
    page.click("#charts tr.go")
    expect(page.locator(".wbv-read")).to_be_visible()
    read = page.inner_text(".wbv-read")
    assert "garment, vertex 3796" in read
    assert f"{incident['depth_mm']:.2f} mm" in read
    assert page.evaluate("workbenchView.frame()") == incident["worst_frame"]
