"""The inspector's page: its figures are the report's, every cell can be asked, and it needs no network."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from widgets import inspector_view
from widgets.frontend_bundle import NotBundled
from widgets.inspector_view import (
    cells,
    close_up,
    garment_regions,
    heat_map,
    inspection_page,
    inspection_scene,
    shown_frames,
    write_inspection,
)
from workbench.collisions.blame import StageArrays, blame, blame_report
from workbench.collisions.inspection import inspect_collisions
from workbench.collisions.inspection_report import inspection_report
from workbench.formats.mesh_sequence import MeshSequence
from workbench.inspector import InspectionResult

FRAMES = 6


@pytest.fixture(scope="module")
def result() -> InspectionResult:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    vertices, faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int64)
    garment = np.repeat(1.1 * vertices[None], FRAMES, axis=0)
    garment[2, vertices[:, 2] > 0.45] *= 0.9 / 1.1
    garment[4:, vertices[:, 0] < -0.45] *= 0.95 / 1.1
    body = MeshSequence(vertices[None], faces, 30.0, "body")
    tensors = [torch.from_numpy(array) for array in (body.vertices, faces, garment, faces)]
    found = inspect_collisions(*tensors)  # pyright: ignore[reportArgumentType, reportCallIssue]
    blamed = blame(
        StageArrays(
            tensors[1], canonical_body=tensors[0][0], regressed=tensors[2], posed=tensors[2], posed_body=tensors[0]
        )
    )
    described = {"file": "a<b>.npz", "vertices": len(vertices), "faces": len(faces)}
    report = {"body": described, "garment": described, "first_frame": 0, "every": 1, "notes": ["a <note>"]}
    report |= inspection_report(found, 30.0) | {"blame": blame_report(blamed)}
    return InspectionResult(body, MeshSequence(garment, faces, 30.0, "garment"), found, blamed, report)


def test_every_collision_has_a_cell_with_its_worst_vertex(result):
    made = cells(result)
    assert sum(cell[2] for cell in made) == result.report["totals"]["inside"]
    of_vertex = garment_regions(result)
    for frame, region, count, depth, vertex, whole in made:
        assert result.found.heat_map[frame, region] == count
        assert result.found.region[frame, vertex] == region
        here = result.found.inside[frame] & (result.found.region[frame] == region)
        assert whole == bool((of_vertex[here] == region).all())
        assert 1e3 * float(result.found.depth[frame, vertex]) == pytest.approx(depth, abs=0.006)
        assert 1e3 * float(result.found.depth_map[frame, region]) == pytest.approx(depth, abs=0.006)
    drawn = {
        (int(f), int(r)) for f, r in re.findall(r'class="cell"[^>]*data-f="(\d+)" data-r="(\d+)"', heat_map(result))
    }
    assert drawn == {(frame, region) for frame, region, *_ in made}


def test_bars_stand_for_every_frame_with_collisions(result):
    frames = {int(f) for f in re.findall(r'class="bar"[^>]*data-f="(\d+)"', heat_map(result))}
    assert frames == {2, 4, 5}


def test_many_frames_share_columns_and_none_of_the_worst_is_lost(result, monkeypatch):
    monkeypatch.setattr(inspector_view, "MOST_COLUMNS", 3)
    frames = {int(f) for f in re.findall(r'class="cell"[^>]*data-f="(\d+)"', heat_map(result))}
    assert frames == {2, 4}


def test_the_page_is_whole_escaped_and_offline(result):
    document = inspection_page(result)
    assert "a&lt;b&gt;.npz" in document
    assert "a<b>" not in document
    assert "a &lt;note&gt;" in document
    assert not re.search(r'(src|href)="(?!data:)', document)
    assert "workbench-view" in document
    data = json.loads(document.split('id="inspection">')[1].split("</script>")[0])
    assert data["shown"] == list(range(FRAMES))
    assert data["inside"] == result.report["per_frame"]["inside"]


def test_the_page_without_3d_says_why(result, monkeypatch):
    assert "as asked (--flat)" in inspection_page(replace(result, flat=True))
    monkeypatch.setattr(inspector_view, "MOST_VERTICES", 100)
    assert "1,284 vertices are more than a page can turn" in inspection_page(result)
    monkeypatch.undo()

    def not_bundled(*_args, **_more):
        raise NotBundled("no Node")

    monkeypatch.setattr(inspector_view, "page", not_bundled)
    assert "The 3-D view is left out: no Node." in inspection_page(result)


def test_a_long_sequence_keeps_the_worst_frames(result, monkeypatch):
    monkeypatch.setattr(inspector_view, "PAGE_BYTES", 4 * inspector_view.BYTES_A_VERTEX * 1284)
    kept = shown_frames(result)
    assert len(kept) <= 4
    worst = {incident["worst_frame"] for incident in result.report["incidents"]}
    assert worst <= set(kept.tolist())
    scene = inspection_scene(result, kept)
    assert scene.frames == len(kept)
    assert scene.frames / scene.fps == pytest.approx(FRAMES / 30.0)  # plays as long as the whole
    assert f"the 3-D view holds {len(kept)} of the frames" in inspection_page(result)


def test_the_scene_marks_what_is_inside(result):
    body, garment = inspection_scene(result).views[0].layers
    np.testing.assert_array_equal(garment.marked, result.found.inside.numpy())  # pyright: ignore[reportAttributeAccessIssue]
    depth, cause = garment.choices  # pyright: ignore[reportAttributeAccessIssue]
    assert depth.limits[1] == pytest.approx(50, abs=2)  # pyright: ignore[reportOptionalSubscript]
    assert set(np.unique(cause.values[result.found.inside.numpy()])) == {4.0}  # the regressor's
    assert body.regions.names == result.found.regions.names  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]


def test_a_close_up_looks_from_outside_at_its_vertex(result):
    incident = result.report["incidents"][0]
    scene = close_up(result, incident["worst_frame"], incident["worst_vertex"])
    assert scene.frames == 1
    assert scene.camera is not None
    place = result.garment.vertices[incident["worst_frame"], incident["worst_vertex"]]
    np.testing.assert_allclose(scene.camera.target, place, atol=1e-6)
    assert np.linalg.norm(scene.camera.position) > 1  # outside of the ball of 0.5
    with pytest.raises(ValueError, match="there is no vertex 0 in frame 9: the garment has 642 in 6 frames"):
        close_up(result, 9, 0)


def test_is_written_whole(result, tmp_path):
    path = write_inspection(result, tmp_path / "report.html")
    assert path == Path(tmp_path / "report.html")
    assert path.read_text(encoding="utf-8") == inspection_page(result)
