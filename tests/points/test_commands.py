"""`workbench fit` and `workbench animate`, with a small model on a scan of its own making."""

import json

import numpy as np
import pytest
import torch

from workbench import cli
from workbench.formats.mesh_sequence import read_mesh
from workbench.formats.scans import read_scan
from workbench.geometry.mesh import vertex_normals
from workbench.motion import Motion
from workbench.points.animate_command import AnimatedPoints, surfels
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.trained_points import TrainedPoints
from workbench.points.uv_position_map import posed_bodies

QUICK = ["--fitting.fit.steps", "3", "--fitting.queries", "300", "--fitting.scan-points", "500"]


@pytest.fixture
def made(body, small_model, trained_like, tmp_path):
    """A model, a scan of a body grown by 1 cm, a motion of two frames."""
    small_model.encoder.config = small_model.config.encoder
    TrainedPoints(trained_like(small_model), ("dress", "shorts", "tshirt")).save(tmp_path / "m.safetensors", body)
    rotations = body.rest_rotations().repeat(2, 1, 1, 1)
    betas = body.mean_shape()
    betas[0] = 1
    vertices = posed_bodies(body, rotations[:1], betas).vertices[0]
    normals = vertex_normals(vertices, body.faces)
    scan = ScanSequence.of(
        [ScanFrame(vertices + 0.01 * normals, normals)],
        outfit="coat",
        motion="m",
        rotations=rotations[:1],
        betas=betas,
        fps=30.0,
    )
    scan.save(tmp_path / "s.npz")
    Motion(rotations, torch.zeros(2, 3), 30.0, body.skeleton, "still").save(tmp_path / "still.npz")
    return tmp_path


def words(made, *more):
    return [*(str(word) for word in more), "--model", str(made / "m.safetensors")]


def refused(capsys, arguments):
    assert cli.main(arguments) == cli.UNUSABLE
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_a_scan_is_fitted_and_animated(made, capsys):
    assert cli.main(words(made, "fit", made / "s.npz", "--out", made / "fit", *QUICK)) == 0
    assert "loss" in capsys.readouterr().out
    report = json.loads((made / "fit" / "report.json").read_text())
    assert report["loss"]["after"] < report["loss"]["before"]
    assert report["scan"] == "coat_m_0"
    assert len(read_scan(made / "fit" / "fitted.ply")) == 40_898
    animated = words(made, "animate", made / "fit", "--motion", made / "still.npz", "--out", made / "a")
    assert cli.main([*animated, "--points", "2000", "--ply", "--glb"]) == 0
    with np.load(made / "a" / "points.npz") as file:
        assert file["points"].shape == file["normals"].shape == (2, 2000, 3)
        assert file["betas"][0] == 1  # who was scanned is who moves
        points = file["points"]
    np.testing.assert_allclose(read_scan(made / "a" / "ply" / "frame_0001.ply").points, points[1], atol=1e-6)
    assert (made / "a" / "surfels.glb").read_bytes().startswith(b"glTF")


def test_meshes(made):
    pytest.importorskip("open3d")
    asked = ["animate", "tshirt", "--motion", made / "still.npz", "--out", made / "a", "--frames", "1", "--mesh"]
    assert cli.main(words(made, *asked, "--meshing.depth", "5")) == 0
    mesh = read_mesh(made / "a" / "meshes" / "frame_0000.ply")
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(1.7, abs=0.2)


def test_unusable_fits_are_told_in_a_line(made, capsys):
    moving = ["--motion", made / "still.npz", "--out", made / "a"]
    line = refused(capsys, words(made, "animate", "cape", *moving))
    assert "knows no outfit 'cape'; it was trained on dress, shorts, tshirt" in line
    line = refused(capsys, words(made, "animate", made / "nowhere" / "fit", *moving))
    assert "no fitted outfit at" in line
    assert "asks for no point" in refused(capsys, words(made, "animate", "dress", *moving, "--points", "0"))
    assert "leaves no frame" in refused(capsys, words(made, "animate", "dress", *moving, "--frames", "0"))
    line = refused(capsys, ["fit", str(made / "s.npz"), "--out", str(made / "f"), "--model", str(made / "none")])
    assert "there is no trained network" in line
    (made / "empty.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
                                    "property float z\nend_header\n")  # fmt: skip
    assert "holds no points" in refused(capsys, words(made, "fit", made / "empty.ply", "--out", made / "f"))


def test_surfels_lie_across_their_normals():
    generator = torch.Generator().manual_seed(0)
    n = torch.nn.functional.normalize(torch.randn(2, 50, 3, generator=generator), dim=-1)
    x = torch.randn(2, 50, 3, generator=generator)
    mesh = surfels(AnimatedPoints(x, n, torch.zeros(10), 30.0), 50)
    corners = torch.from_numpy(mesh.vertices).view(2, 50, 3, 3)
    torch.testing.assert_close(corners.mean(2), x, atol=1e-5, rtol=0)
    across = ((corners - x[:, :, None]) * n[:, :, None]).sum(-1)
    torch.testing.assert_close(across, torch.zeros_like(across), atol=1e-5, rtol=0)
    face = torch.linalg.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    assert ((face * n).sum(-1) > 0).all()
