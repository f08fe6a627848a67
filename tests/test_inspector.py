"""`workbench inspect`: any mesh sequences in, report out; every unusable input is one line with what to do."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from workbench import cli, inspector
from workbench.formats.mesh_sequence import (
    DressedSequence,
    Mesh,
    MeshSequence,
    write_dressed_sequence,
    write_mesh,
    write_mesh_folder,
    write_mesh_sequence,
)
from workbench.inspector import InspectConfig, read_pair, run

FRAMES = 4


@pytest.fixture(scope="module")
def pair() -> DressedSequence:
    """A ball of 0.5 m that rises, in a wider one; in frame 2 a cap of that is inside."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    vertices, faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int64)
    lift = np.linspace(0, 0.3, FRAMES, dtype=np.float32)[:, None, None] * np.array([0, 0, 1], np.float32)
    garment = np.repeat(1.1 * vertices[None], FRAMES, axis=0)
    garment[2, vertices[:, 2] > 0.45] *= 0.9 / 1.1
    return DressedSequence(
        MeshSequence(vertices + lift, faces, 25.0, "body"), MeshSequence(garment + lift, faces, 25.0, "garment")
    )


@pytest.fixture
def folder(tmp_path, pair):
    """The pair in every format."""
    write_dressed_sequence(tmp_path / "both.npz", pair)
    for name, mesh in (("body", pair.body), ("garment", pair.garment)):
        write_mesh_sequence(tmp_path / f"{name}.npz", mesh)
        write_mesh_sequence(tmp_path / f"{name}.pc2", mesh)
        write_mesh_folder(tmp_path / f"{name}_obj", mesh, ".obj")
        write_mesh_folder(tmp_path / f"{name}_ply", mesh, ".ply")
        write_mesh(tmp_path / f"still_{name}.obj", Mesh(mesh.vertices[2], mesh.faces))
    return tmp_path


def refused(capsys, *words) -> str:
    assert cli.main(["inspect", *map(str, words)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def inspected(folder, *words) -> dict:
    out = folder / "out"
    assert cli.main(["inspect", *map(str, words), "--out", str(out)]) == 0
    return json.loads((out / "report.json").read_text())


def test_every_format_says_the_same(folder):
    sources = [("both.npz",), ("both.npz", "both.npz"), ("body.npz", "garment.npz"), ("body.pc2", "garment_obj")]
    sources += [("body_ply", "garment.pc2"), ("both.npz", "garment_ply")]
    reports = [
        run(InspectConfig(folder / names[0], *(folder / n for n in names[1:]), out=folder / "out")).report
        for names in sources
    ]
    first = reports[0]
    assert first["totals"]["inside"] > 5
    assert first["per_frame"]["inside"][2] == first["totals"]["inside"]
    assert first["incidents"][0]["worst_frame"] == 2
    assert first["totals"]["depth_mm"]["max"] == pytest.approx(50, abs=3)
    for report in reports[1:]:
        assert report["totals"] == first["totals"]
        assert report["inside_by_frame_and_region"] == first["inside_by_frame_and_region"]


def test_the_command_writes_report_and_page(folder, capsys):
    report = inspected(folder, folder / "both.npz")
    assert report["garment"]["file"].endswith("both.npz")
    page = (folder / "out" / "report.html").read_text()
    assert "Collisions: both.npz" in page
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "of the garment's vertices are inside the body, at most" in printed.out
    assert "report.html" in printed.out


def test_a_body_that_stands_still_serves_all_frames(folder, pair):
    still = replace(
        pair.garment, vertices=pair.garment.vertices - pair.body.vertices[:, :1] + pair.body.vertices[2, :1]
    )
    write_mesh_sequence(folder / "still.npz", still)
    report = run(InspectConfig(folder / "still_body.obj", folder / "still.npz", out=folder / "out")).report
    assert report["per_frame"]["inside"] == [0, 0, report["totals"]["inside"], 0]


def test_chosen_frames(folder):
    config = InspectConfig(folder / "both.npz", out=folder / "out", start=2, stop=4)
    result = run(config)
    assert result.report["frames"] == 2
    assert result.report["per_frame"]["inside"][0] == result.report["totals"]["inside"] > 0
    assert run(replace(config, start=0, stop=None, every=2)).report["fps"] == 12.5


def test_no_collision_is_said(folder, pair, caplog):
    free = replace(pair, garment=replace(pair.garment, vertices=pair.garment.vertices[[0, 0, 0, 0]]))
    free = replace(free, body=replace(pair.body, vertices=pair.body.vertices[[0, 0, 0, 0]]))
    write_dressed_sequence(folder / "free.npz", free)
    with caplog.at_level("INFO"):
        run(InspectConfig(folder / "free.npz", out=folder / "out"))
    assert "no collision in 4 frames of 642 vertices" in caplog.text


def test_a_body_model_names_the_regions(folder, body, tmp_path):
    body.save(tmp_path / "model.npz")
    with pytest.raises(ValueError, match="the body has 642 vertices, but the model 'default' has 13348"):
        run(InspectConfig(folder / "both.npz", out=folder / "out", body_model=tmp_path / "model.npz"))


def test_stages_in_the_file_are_blamed(folder, pair):
    """The file carries the canonical garment and the constant body: its fault was there already."""
    canonical_body = pair.body.vertices[0]
    canonical = pair.garment.vertices - (pair.body.vertices - canonical_body)
    write_dressed_sequence(folder / "tryon.npz", pair, canonical=canonical, canonical_body=canonical_body)
    report = run(InspectConfig(folder / "tryon.npz", out=folder / "out")).report
    assert report["blame"]["by_cause"] == {
        "regressor": report["totals"]["inside"],
        "unprojection": 0,
        "body overlap": 0,
    }
    write_dressed_sequence(folder / "tryon.npz", pair, canonical=canonical)
    report = run(InspectConfig(folder / "tryon.npz", out=folder / "out")).report
    assert report["blame"] is None
    assert "the garment's stage 'regressed' cannot be blamed: the file lacks canonical_body" in report["notes"]


# --- unusable input


def test_absent_and_foreign_files_are_refused(folder, capsys):
    out = ("--out", folder / "out")
    assert "no mesh sequence at absent" in refused(capsys, "absent", *out)
    assert "no mesh sequence at absent" in refused(capsys, folder / "body.npz", "absent", *out)
    line = refused(capsys, folder / "body.npz", *out)
    assert "does not hold a body and a garment (it holds faces, fps, vertices); give BODY and GARMENT" in line
    assert "the GARMENT is missing: only an .npz holds both" in refused(capsys, folder / "body_obj", *out)
    assert "BODY and GARMENT are the same file" in refused(capsys, folder / "body_obj", folder / "body_obj", *out)
    (folder / "broken.npz").write_bytes(b"PK\x03\x04 and no more")
    assert "is not readable" in refused(capsys, folder / "broken.npz", *out)
    assert "--out" in refused(capsys, folder / "body.npz")


def test_frame_counts_that_differ_are_told_and_can_be_cut(folder, pair, capsys):
    write_mesh_sequence(folder / "short.npz", replace(pair.garment, vertices=pair.garment.vertices[:3]))
    words = (folder / "body.npz", folder / "short.npz", "--out", folder / "out")
    assert "the body has 4 frames, the garment 3: add --cut to use the first 3 of both" in refused(capsys, *words)
    report = inspected(folder, folder / "body.npz", folder / "short.npz", "--cut")
    assert report["frames"] == 3
    assert report["notes"][0].startswith("only the first 3 frames are used")


def test_nan_is_told_with_its_place(folder, pair, capsys):
    broken = pair.garment.vertices.copy()
    broken[1, 7] = np.nan
    np.savez(folder / "nan.npz", vertices=broken, faces=pair.garment.faces)
    line = refused(capsys, folder / "body.npz", folder / "nan.npz", "--out", folder / "out")
    assert line.endswith("nan.npz holds NaN or infinite coordinates: 1 vertices in 1 frames, first vertex 7 in frame 1")


def test_units_and_axes_are_told_and_the_proposed_flags_work(folder, pair, capsys):
    scaled = replace(pair.garment, vertices=1000 * pair.garment.vertices)
    write_mesh_sequence(folder / "mm.npz", scaled)
    words = [folder / "body.npz", folder / "mm.npz"]
    assert "add --garment-unit mm" in refused(capsys, *words, "--out", folder / "out")
    report = inspected(folder, *words, "--garment-unit", "mm")
    assert report["totals"]["inside"] > 5
    assert "the garment was read as mm, z up" in report["notes"]
    write_mesh_sequence(folder / "mm_body.npz", replace(pair.body, vertices=1000 * pair.body.vertices))
    words = [folder / "mm_body.npz", folder / "mm.npz"]
    assert "add --body-unit mm (and --garment-unit mm" in refused(capsys, *words, "--out", folder / "out")
    assert inspected(folder, *words, "--body-unit", "mm", "--garment-unit", "mm")["totals"] == report["totals"]


def test_open_and_inside_out_bodies_are_told_and_the_proposed_flags_work(folder, pair, capsys):
    garment = folder / "garment.npz"
    write_mesh_sequence(folder / "open.npz", replace(pair.body, faces=pair.body.faces[1:]))
    assert "the body is open: 1 holes" in refused(capsys, folder / "open.npz", garment, "--out", folder / "out")
    report = inspected(folder, folder / "open.npz", garment, "--fill-holes")
    assert report["totals"]["inside"] > 5
    write_mesh_sequence(folder / "turned.npz", replace(pair.body, faces=pair.body.faces[:, ::-1].copy()))
    assert "the body is inside out" in refused(capsys, folder / "turned.npz", garment, "--out", folder / "out")
    assert inspected(folder, folder / "turned.npz", garment, "--flip-body")["totals"]["inside"] > 5


def test_frames_that_are_not_there(folder, capsys):
    words = (folder / "both.npz", "--out", folder / "out")
    assert "--every 0 keeps no frame" in refused(capsys, *words, "--every", 0)
    assert "--start 9 --stop None keep none of 4 frames" in refused(capsys, *words, "--start", 9)


def test_too_much_for_the_memory_is_told_with_what_to_do(folder, capsys, monkeypatch):
    monkeypatch.setattr(inspector, "_memory", lambda: 50_000.0)
    line = refused(capsys, folder / "both.npz", "--out", folder / "out")
    assert "4 frames of 1,284 vertices need 0.0 GB of memory" in line
    assert "add --every 4" in line


def test_a_million_vertices_are_inspected_and_the_page_says_what_it_leaves_out(folder, capsys):
    """A flat million-vertex sheet through a ball: counted in full; the page holds figures and a line, no 3-D view."""
    side = 1001
    grid = np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, side, dtype=np.float32)] * 2, indexing="ij"), -1)
    sheet = np.concatenate([grid, np.full((side, side, 1), 0.1, np.float32)], -1).reshape(1, -1, 3)
    corner = np.arange(side * side).reshape(side, side)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel(), corner[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    np.savez(folder / "million.npz", vertices=sheet, faces=faces)
    report = inspected(folder, folder / "still_body.obj", folder / "million.npz", "--garment-unit", "m")
    height = 0.1 - 0.2  # of the sheet over the ball's middle, in frame 2
    disc = np.pi * (0.25 - height**2) / 1.2**2
    assert report["totals"]["inside_percent"] == pytest.approx(100 * disc, rel=0.02)
    assert "1,002,643 vertices in each of 1 frames: about 5 s" in capsys.readouterr().out
    page = (folder / "out" / "report.html").read_text()
    assert "The 3-D view is left out: 1,002,643 vertices are more than a page can turn" in page


def test_a_shipped_sequence_is_clean(tmp_path):
    """A simulated sequence is read as body and garment; every shipped frame is free of collisions."""
    from workbench.collisions.sequences import SHIPPED

    config = InspectConfig(SHIPPED / "tshirt_squat.npz", out=tmp_path / "out", every=25)
    assert read_pair(config)[0].body.vertices.shape == (75, 13348, 3)
    result = run(config)
    assert result.report["totals"]["inside"] == 0
    assert result.report["regions"]["source"] == "skinning weights of 'default'"
    assert set(result.found.region_of_vertex.tolist()) <= set(result.found.region.flatten().tolist())
