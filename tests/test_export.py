"""Export: one sequence in, the same vertices out in every format."""

import numpy as np
import pytest
import trimesh

from workbench import cli
from workbench.formats.gltf import read_glb
from workbench.formats.mesh_sequence import (
    DressedSequence,
    MeshSequence,
    read_dressed_sequence,
    read_mesh,
    read_mesh_sequence,
    write_dressed_sequence,
)
from workbench.garments import Garment


@pytest.fixture
def dressed(tmp_path, rng):
    def moving(name, subdivisions):
        ball = trimesh.creation.icosphere(subdivisions)
        vertices = ball.vertices[None] + rng.normal(size=(6, 1, 3))
        return MeshSequence(vertices.astype(np.float32), np.asarray(ball.faces, np.int64), 30.0, name)

    sequence = DressedSequence(moving("body", 1), moving("garment", 2))
    write_dressed_sequence(tmp_path / "in.npz", sequence)
    return sequence


def export(tmp_path, *words):
    return cli.main(["export", str(tmp_path / "in.npz"), *map(str, words)])


def test_glb_shows_both(tmp_path, dressed):
    assert export(tmp_path, "--out", tmp_path / "a.glb") == 0
    body, garment = read_glb(tmp_path / "a.glb")
    assert np.abs(body.vertices - dressed.body.vertices).max() < 1e-4
    assert np.abs(garment.vertices - dressed.garment.vertices).max() < 1e-4


@pytest.mark.parametrize("kind", ["obj", "ply", "pc2"])
def test_folders_hold_the_same_vertices(tmp_path, dressed, kind):
    assert export(tmp_path, "--out", tmp_path / "out", "--format", kind) == 0
    for mesh in (dressed.body, dressed.garment):
        name = f"{mesh.name}.pc2" if kind == "pc2" else mesh.name
        np.testing.assert_array_equal(read_mesh_sequence(tmp_path / "out" / name).vertices, mesh.vertices)


def test_the_body_and_a_garment_are_written_as_meshes_that_fit_each_other(tmp_path, body):
    for word in ("body", "tshirt"):
        assert cli.main(["export", word, "--out", str(tmp_path / f"{word}.obj")]) == 0
    surface = read_mesh(tmp_path / "body.obj")
    np.testing.assert_allclose(surface.vertices, body.template.numpy(), atol=1e-6)
    (tmp_path / "tshirt.obj").rename(tmp_path / "mine.obj")
    mine, shirt = Garment.load(tmp_path / "mine.obj"), Garment.load("tshirt")  # loading asks whether it fits the body
    np.testing.assert_allclose(mine.vertices, shirt.vertices, atol=1e-6)
    assert mine.faces.equal(shirt.faces)


def test_every_nth_frame_keeps_the_speed(tmp_path, dressed):
    assert export(tmp_path, "--out", tmp_path / "b.npz", "--every", 2) == 0
    read = read_dressed_sequence(tmp_path / "b.npz")
    np.testing.assert_array_equal(read.garment.vertices, dressed.garment.vertices[::2])
    assert read.garment.fps == 15.0


def test_unusable_wishes_are_told(tmp_path, dressed, capsys):
    for words, line in (
        (("--out", tmp_path / "a.fbx"), "cannot tell the format"),
        (("--out", tmp_path / "a.glb", "--every", 0), "--every 0 keeps no frame"),
        (("--out", tmp_path / "a.glb", "--format", "fbx"), "--format"),
    ):
        assert export(tmp_path, *words) == 2
        told = capsys.readouterr().err.splitlines()
        assert len(told) == 1
        assert line in told[0]
    assert [path.name for path in tmp_path.iterdir()] == ["in.npz"]
