"""Moving meshes: what is written is read back; each damage has its line."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.formats.mesh_sequence import (
    DressedSequence,
    Mesh,
    MeshSequence,
    read_dressed_sequence,
    read_mesh,
    read_mesh_sequence,
    write_dressed_sequence,
    write_mesh,
    write_mesh_folder,
    write_mesh_sequence,
)

FACES = np.array([[0, 1, 2], [2, 1, 3]])


@pytest.fixture
def sequence(rng):
    return MeshSequence(rng.normal(size=(5, 4, 3)).astype(np.float32), FACES, 25.0, "cloth")


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_mesh_returns_exactly(tmp_path, sequence, suffix):
    write_mesh(tmp_path / f"m{suffix}", Mesh(sequence.vertices[0], FACES))
    read = read_mesh(tmp_path / f"m{suffix}")
    np.testing.assert_array_equal(read.vertices, sequence.vertices[0])
    np.testing.assert_array_equal(read.faces, FACES)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=9, max_size=9))
def test_every_float_survives_an_obj(tmp_path_factory, numbers):
    path = tmp_path_factory.mktemp("obj") / "m.obj"
    vertices = np.array(numbers, np.float32).reshape(3, 3)
    write_mesh(path, Mesh(vertices, np.array([[0, 1, 2]])))
    np.testing.assert_array_equal(read_mesh(path).vertices, vertices)


def test_obj_of_others_is_read(tmp_path):
    """Polygons, texture and normal indices, negative indices, vertex colours, comments."""
    text = (
        "# made elsewhere\nmtllib a.mtl\nv 0 0 0 1 0 0\nv 1 0 0\nvt 0 0\nvn 0 0 1\nv 1 1 0\nv 0 1 0\n"
        "o sheet\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf -4//1 -3//1 -2//1\n"
    )
    (tmp_path / "m.obj").write_text(text)
    read = read_mesh(tmp_path / "m.obj")
    assert read.vertices.shape == (4, 3)
    np.testing.assert_array_equal(read.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])


@pytest.mark.parametrize("suffix", [".npz", ".pc2", ".obj", ".ply"])
def test_sequence_returns_exactly(tmp_path, sequence, suffix):
    target = tmp_path / (f"cloth{suffix}" if suffix in (".npz", ".pc2") else "cloth")
    if suffix == ".ply":
        write_mesh_folder(target, sequence, suffix)
    else:
        write_mesh_sequence(target, sequence)
    read = read_mesh_sequence(target, fps=None if suffix == ".npz" else 25.0)
    np.testing.assert_array_equal(read.vertices, sequence.vertices)
    np.testing.assert_array_equal(read.faces, sequence.faces)
    assert read.fps == 25.0
    assert read.name == "cloth"


def test_dressed_sequence_returns_with_what_else_is_in_it(tmp_path, sequence):
    body = MeshSequence(sequence.vertices[:, ::-1].copy(), FACES, 25.0, "body")
    dressed = DressedSequence(body, MeshSequence(sequence.vertices, FACES, 25.0, "garment"))
    write_dressed_sequence(tmp_path / "d.npz", dressed, canonical=sequence.vertices + 1)
    read = read_dressed_sequence(tmp_path / "d.npz")
    for got, given_ in ((read.body, dressed.body), (read.garment, dressed.garment)):
        np.testing.assert_array_equal(got.vertices, given_.vertices)
        assert (got.fps, got.name) == (given_.fps, given_.name)
    np.testing.assert_array_equal(np.load(tmp_path / "d.npz")["canonical"], sequence.vertices + 1)


def test_folder_whose_topology_changes_is_refused(tmp_path, sequence):
    paths = write_mesh_folder(tmp_path / "f", sequence, ".obj")
    write_mesh(paths[3], Mesh(sequence.vertices[3], FACES[:, ::-1].copy()))
    with pytest.raises(ValueError, match=r"cloth_0003\.obj .* not those of cloth_0000\.obj .* keeps one topology"):
        read_mesh_sequence(tmp_path / "f")
    write_mesh(paths[3], Mesh(sequence.vertices[3][:3], FACES[:1]))
    with pytest.raises(ValueError, match="has 3 vertices and 1 faces"):
        read_mesh_sequence(tmp_path / "f")


def test_different_frame_counts_are_refused(tmp_path, sequence):
    arrays = {"body_faces": FACES, "garment_faces": FACES, "fps": 30.0, "garment_vertices": sequence.vertices}
    np.savez(tmp_path / "d.npz", body_vertices=sequence.vertices[:3], **arrays)
    with pytest.raises(ValueError, match="the body has 3 frames, the garment 5"):
        read_dressed_sequence(tmp_path / "d.npz")


def test_pc2_that_does_not_fit_is_refused(tmp_path, sequence):
    path = tmp_path / "c.pc2"
    write_mesh_sequence(path, sequence)
    whole = path.read_bytes()
    path.write_bytes(whole[:-4])
    with pytest.raises(ValueError, match=r"is damaged: 268 bytes, expected 272 for 5 frames"):
        read_mesh_sequence(path)
    path.write_bytes(whole[:10])
    with pytest.raises(ValueError, match="not a PC2 point cache"):
        read_mesh_sequence(path)
    path.write_bytes(whole)
    write_mesh(path.with_suffix(".obj"), Mesh(sequence.vertices[0][:3], FACES[:1]))
    with pytest.raises(ValueError, match="moves 4 points, but c.obj has 3 vertices"):
        read_mesh_sequence(path)
    path.with_suffix(".obj").unlink()
    with pytest.raises(FileNotFoundError, match=r"holds no faces: put the mesh beside it as c\.obj"):
        read_mesh_sequence(path)


BAD_ARRAYS = {
    "vertices": (
        (np.zeros((4, 3)), r"vertices is float64 \(4, 3\), expected numbers \(T, N, 3\)"),
        (np.zeros((0, 4, 3)), "has no frames"),
        (np.full((2, 4, 3), np.nan), "NaN or infinite coordinates"),
    ),
    "faces": (
        (np.zeros((2, 4), int), r"faces is int64 \(2, 4\), expected whole numbers \(F, 3\)"),
        (np.array([[0, 1, 4]]), "faces index vertex 4, but the mesh has 4 vertices"),
        (np.array([[0, 1, -1]]), "faces index vertex -1"),
        (np.zeros((0, 3), int), "4 vertices and 0 faces: expected a mesh"),
    ),
}


@pytest.mark.parametrize("key", BAD_ARRAYS)
def test_bad_arrays_are_told(tmp_path, sequence, key):
    good = {"vertices": sequence.vertices, "faces": FACES}
    for value, message in BAD_ARRAYS[key]:
        np.savez(tmp_path / "s.npz", **good | {key: value})
        with pytest.raises(ValueError, match=message):
            read_mesh_sequence(tmp_path / "s.npz")


def test_bad_meshes_are_told(tmp_path):
    bad = {
        "v 0 0\n": "m.obj, line 1: a vertex needs three numbers",
        "v 0 0 0\nv a b c\n": "m.obj, line 2: could not convert",
        "v 0 0 0\nf 1 1\n": "m.obj, line 2: a face needs three vertices, counted from 1",
        "v 0 0 0\nf 0 1 1\n": "m.obj, line 2: a face needs three vertices, counted from 1",
        "v 0 0 0\nf 1 1 9\n": "faces index vertex 8, but the mesh has 1 vertices",
        "v 0 0 0\nv 0 0 nan\nf 1 1 2\n": "NaN or infinite",
        "": "0 vertices and 0 faces: expected a mesh",
    }
    for text, message in bad.items():
        (tmp_path / "m.obj").write_text(text)
        with pytest.raises(ValueError, match=message):
            read_mesh(tmp_path / "m.obj")
    for content in (b"", b"ply\nformat", b"no ply at all"):
        (tmp_path / "m.ply").write_bytes(content)
        with pytest.raises(ValueError, match="m.ply is not a readable PLY mesh"):
            read_mesh(tmp_path / "m.ply")


def test_wrong_paths_are_told(tmp_path, sequence):
    with pytest.raises(FileNotFoundError, match="no mesh file at"):
        read_mesh(tmp_path / "absent.obj")
    with pytest.raises(FileNotFoundError, match="no mesh sequence at"):
        read_mesh_sequence(tmp_path / "absent.pc2")
    with pytest.raises(ValueError, match=r"holds no \.obj or \.ply files"):
        read_mesh_sequence(tmp_path)
    (tmp_path / "a.abc").touch()
    with pytest.raises(ValueError, match="is no mesh sequence: expected a folder"):
        read_mesh_sequence(tmp_path / "a.abc")
    with pytest.raises(ValueError, match=r"is no mesh file: expected \.obj or \.ply"):
        read_mesh(tmp_path / "a.abc")
    with pytest.raises(ValueError, match="cannot write a mesh sequence to"):
        write_mesh_sequence(tmp_path / "a.mdd", sequence)
    with pytest.raises(ValueError, match="cannot write a mesh to"):
        write_mesh(tmp_path / "a.stl", Mesh(sequence.vertices[0], FACES))
