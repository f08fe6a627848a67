"""Animated GLB: what is written is what a viewer shows, and the file is what the glTF 2.0 specification asks for."""

import json
import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from workbench.formats.gltf import (
    GltfMesh,
    continuous_quaternions,
    dressed_meshes,
    read_glb,
    rigid_motion,
    vertex_normals,
    write_glb,
)
from workbench.formats.mesh_sequence import MeshSequence

FRAMES = 7
COMPONENT_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def moving(name, subdivisions=2, turn=2.0, fps=30.0, frames=FRAMES):
    """A ball that walks, turns by 60 degrees a step and swells."""
    ball = trimesh.creation.icosphere(subdivisions)
    steps = np.linspace(0.0, turn, frames)
    turned = Rotation.from_rotvec(steps[:, None] * np.array([0.3, 0.2, np.pi])).as_matrix()
    swollen = ball.vertices * (1 + 0.2 * np.sin(steps[:, None, None] + 3 * ball.vertices[None, :, :1]))
    vertices = np.einsum("tij,tnj->tni", turned, swollen) + steps[:, None, None] * np.array([1.0, -2.0, 0.5])
    return MeshSequence(vertices.astype(np.float32), np.asarray(ball.faces, np.int64), fps, name)


def parts(path):
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :], content


def values(document, binary, index):
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    dtype = {5120: "<i1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
    width, size = WIDTHS[accessor["type"]], np.dtype(dtype).itemsize
    start = view["byteOffset"] + accessor["byteOffset"]
    stride = view.get("byteStride", width * size)
    array = np.ndarray((accessor["count"], width), dtype, binary, start, strides=(stride, size)).astype(float)
    return array / np.iinfo(dtype).max if accessor.get("normalized") else array


def test_every_frame_returns_within_a_step_of_the_whole_numbers(tmp_path):
    first, second = moving("body"), moving("garment", subdivisions=1, turn=1.0)
    write_glb(tmp_path / "a.glb", dressed_meshes(first, second))
    scales = [node["scale"][0] for node in parts(tmp_path / "a.glb")[0]["nodes"] if "mesh" in node]
    for got, given, scale in zip(read_glb(tmp_path / "a.glb"), (first, second), scales, strict=True):
        # base and difference are each rounded by half a step, in axes that turn
        assert np.abs(got.vertices - given.vertices).max() < np.sqrt(3) * scale / 32767 + 1e-6
        assert scale < 4  # metres: the balls part by 1.3 m and turn
        np.testing.assert_array_equal(got.faces, given.faces)
        assert got.name == given.name
        assert got.fps == pytest.approx(given.fps, rel=1e-5)


def test_long_walk_costs_no_precision(tmp_path):
    near = moving("a")
    far = MeshSequence(near.vertices + np.linspace(0, 500, FRAMES, dtype=np.float32)[:, None, None], near.faces)
    write_glb(tmp_path / "a.glb", [GltfMesh(far)])
    assert np.abs(read_glb(tmp_path / "a.glb")[0].vertices - far.vertices).max() < 2e-4  # float32 at 500 m: 3e-5


def test_viewer_sees_y_up_and_the_front_towards_plus_z(tmp_path):
    write_glb(tmp_path / "a.glb", [GltfMesh(moving("a"))])
    document, _, _ = parts(tmp_path / "a.glb")
    root = Rotation.from_quat(document["nodes"][0]["rotation"]).as_matrix()
    np.testing.assert_allclose(root @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(root @ [0, -1, 0], [0, 0, 1], atol=1e-12)
    assert np.linalg.det(root) == pytest.approx(1)


def test_normals_at_each_frame_are_those_of_the_surface(tmp_path):
    """They turn by more than 90 degrees here, which a whole-number difference alone cannot hold."""
    sequence = moving("a", turn=2.0)
    write_glb(tmp_path / "a.glb", [GltfMesh(sequence)])
    document, binary, _ = parts(tmp_path / "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    base = values(document, binary, primitive["attributes"]["NORMAL"])
    targets = np.stack([values(document, binary, target["NORMAL"]) for target in primitive["targets"]])
    channels = {channel["target"]["path"]: channel["sampler"] for channel in document["animations"][0]["channels"]}

    def animated(path):
        return values(document, binary, document["animations"][0]["samplers"][channels[path]]["output"])

    weights = animated("weights").reshape(FRAMES, -1)
    shown = base + np.einsum("tk,kni->tni", weights, targets)
    shown = np.einsum("tij,tnj->tni", Rotation.from_quat(animated("rotation")).as_matrix(), shown)
    shown /= np.linalg.norm(shown, axis=-1, keepdims=True)
    truth = vertex_normals(sequence.vertices.astype(float), sequence.faces)
    assert np.degrees(np.arccos(np.clip((shown * truth).sum(-1), -1, 1))).max() < 1.0
    np.testing.assert_allclose(base, vertex_normals(sequence.vertices[:1].astype(float), sequence.faces)[0], atol=1e-3)


def test_file_keeps_to_the_specification(tmp_path):
    write_glb(tmp_path / "a.glb", dressed_meshes(moving("body"), moving("garment", 1)))
    document, binary, content = parts(tmp_path / "a.glb")
    assert content[:4] == b"glTF"
    assert struct.unpack_from("<II", content, 4) == (2, len(content))
    assert document["asset"]["version"] == "2.0"
    assert document["buffers"][0]["byteLength"] == len(binary)
    assert document["extensionsRequired"] == ["KHR_mesh_quantization"]
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        size = COMPONENT_SIZES[accessor["componentType"]] * WIDTHS[accessor["type"]]
        stride = view.get("byteStride", size)
        assert (view["byteOffset"] + accessor["byteOffset"]) % 4 == 0
        assert accessor["byteOffset"] + stride * (accessor["count"] - 1) + size <= view["byteLength"]
        assert view["byteOffset"] + view["byteLength"] <= len(binary)
        if "byteStride" in view:
            assert stride % 4 == 0
    for mesh in document["meshes"]:
        primitive = mesh["primitives"][0]
        position = document["accessors"][primitive["attributes"]["POSITION"]]
        assert len(mesh["weights"]) == len(primitive["targets"]) == len(mesh["extras"]["targetNames"])
        indices = values(document, binary, primitive["indices"])
        assert indices.max() < position["count"]
        for target in [primitive["attributes"], *primitive["targets"]]:
            told = document["accessors"][target["POSITION"]]
            raw = np.round(values(document, binary, target["POSITION"]) * 32767)
            np.testing.assert_array_equal(raw.min(0), told["min"])
            np.testing.assert_array_equal(raw.max(0), told["max"])
            assert document["accessors"][target["NORMAL"]]["count"] == position["count"]
        base = values(document, binary, primitive["attributes"]["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(base, axis=1), 1, atol=1e-3)
    animation = document["animations"][0]
    times = values(document, binary, animation["samplers"][0]["input"]).ravel()
    assert (np.diff(times) > 0).all()
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        assert channel["target"]["node"] in (1, 2, 3)
        output = values(document, binary, sampler["output"])
        assert document["accessors"][sampler["input"]]["max"] == [pytest.approx(times[-1])]
        if channel["target"]["path"] == "weights":
            assert output.min() >= 0  # Blender clamps weights outside [0, 1]
            assert output.max() <= 1
            mesh = document["meshes"][document["nodes"][channel["target"]["node"]]["mesh"]]
            assert len(output) == FRAMES * len(mesh["weights"])
        else:
            assert len(output) == FRAMES
    assert [material["doubleSided"] for material in document["materials"]] == [False, True]


def test_size_is_twelve_bytes_a_vertex_and_frame(tmp_path):
    sequence = moving("a", subdivisions=4, frames=40)
    write_glb(tmp_path / "a.glb", [GltfMesh(sequence)])
    write_glb(tmp_path / "flat.glb", [GltfMesh(sequence, smooth=False)])
    vertices = sequence.vertices[..., 0].size
    assert (tmp_path / "a.glb").stat().st_size < 14 * vertices
    assert (tmp_path / "flat.glb").stat().st_size < 10 * vertices


def test_one_frame_is_a_still(tmp_path):
    still = moving("a", frames=1)
    write_glb(tmp_path / "a.glb", [GltfMesh(still)])
    document, _, _ = parts(tmp_path / "a.glb")
    assert "animations" not in document
    assert np.abs(read_glb(tmp_path / "a.glb")[0].vertices - still.vertices).max() < 1e-4


def test_rigid_motion_is_found_exactly(rng):
    points = rng.normal(size=(50, 3))
    turned = Rotation.from_rotvec(rng.normal(size=(6, 3))).as_matrix()
    turned[0] = np.eye(3)
    shifts = rng.normal(size=(6, 3))
    frames = (np.einsum("tij,nj->tni", turned, points) + shifts[:, None]).astype(np.float32)
    motion = rigid_motion(frames)
    np.testing.assert_allclose(motion.rotation, turned, atol=1e-5)
    np.testing.assert_allclose(motion.centre, frames.mean(1), atol=1e-5)


def test_flat_mesh_is_never_mirrored(rng):
    """Points in a plane have a mirror image that fits as well: the rotation must stay a rotation."""
    points = rng.normal(size=(50, 3)) * [1, 1, 0]
    frames = np.stack([points, points * [-1, 1, 1]]).astype(np.float32)
    assert np.linalg.det(rigid_motion(frames).rotation) == pytest.approx(1)


def test_quaternions_take_the_short_way():
    turns = Rotation.from_rotvec(np.radians(np.linspace(0, 720, 60))[:, None] * [0, 0, 1]).as_matrix()
    quaternions = continuous_quaternions(turns)
    assert (np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.9).all()


def test_normals_of_a_ball_point_outwards():
    ball = trimesh.creation.icosphere(3)
    normals = vertex_normals(np.asarray(ball.vertices)[None], np.asarray(ball.faces))[0]
    assert (np.sum(normals * ball.vertices, axis=1) > 0.999).all()


def test_what_cannot_move_together_is_told(tmp_path):
    with pytest.raises(ValueError, match="no mesh was given"):
        write_glb(tmp_path / "a.glb", [])
    with pytest.raises(ValueError, match="same number of frames: body has 7, garment has 3"):
        write_glb(tmp_path / "a.glb", dressed_meshes(moving("body"), moving("garment", frames=3)))
    with pytest.raises(ValueError, match=r"one positive frame rate, got \[25.0, 30.0\]"):
        write_glb(tmp_path / "a.glb", dressed_meshes(moving("body"), moving("garment", fps=25.0)))
    assert list(tmp_path.iterdir()) == []


def test_damaged_glb_is_refused(tmp_path):
    path = tmp_path / "a.glb"
    write_glb(path, [GltfMesh(moving("a"))])
    whole = path.read_bytes()
    for content in (b"", whole[:50], whole[:-5], b"PK" + whole[2:], whole[:12] + b"\0" * 40):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"is not an animated \.glb of ours"):
            read_glb(path)
    with pytest.raises(FileNotFoundError, match=r"no \.glb at"):
        read_glb(tmp_path / "absent.glb")
