"""Moving meshes  <->  one animated .glb (glTF 2.0) that Blender, three.js and any glTF viewer play.

Every frame is a morph target, switched on and off by linearly interpolated weights, so a viewer shows exactly our
vertices at each frame and their blend between frames.  Skinning would be smaller, but viewers built on
three.js take four joints a vertex and the body has up to seven: its surface would leave the garment.  Weights stay in
[0, 1], because Blender clamps the others.

The rigid part of the common motion moves one node; the rest is stored as whole numbers (KHR_mesh_quantization):
positions of 16 bits, a step of some 0.03 mm, and normals of 8.  A stored difference reaches one and a normal that turns
over needs two, so one more target, always on, takes the base's normals away, and each frame brings its own.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.spatial.transform import Rotation

from workbench.formats.mesh_sequence import FPS, MeshSequence
from workbench.store import atomic_write

Colour = tuple[float, float, float]  # linear red, green, blue in [0, 1]

SKIN: Colour = (0.72, 0.50, 0.38)
CLOTH: Colour = (0.10, 0.26, 0.52)

ENCODINGS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
FIGURE = 1  # the node that carries all meshes
# glTF is y up: (x, y, z) -> (x, z, -y), so that the body, which faces our -y, faces glTF's +z
Y_UP = (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # x, y, z, w


@dataclass(frozen=True)
class GltfMesh:
    """One moving mesh and how it looks."""

    sequence: MeshSequence
    colour: Colour = (0.8, 0.8, 0.8)
    roughness: float = 0.8
    double_sided: bool = False  # cloth is seen from both sides
    smooth: bool = True  # False leaves out normals: smaller, shown with flat facets


def dressed_meshes(body: MeshSequence, garment: MeshSequence) -> list[GltfMesh]:
    """A body and its garment as they look in a viewer."""
    return [GltfMesh(body, SKIN, roughness=0.6), GltfMesh(garment, CLOTH, roughness=0.9, double_sided=True)]


def write_glb(path: str | Path, meshes: Sequence[GltfMesh]) -> None:
    """Write meshes that move together (same frame count and rate) as one animated .glb.

    Raises ValueError when there is nothing to write or frame counts or rates differ.
    """
    if not meshes:
        raise ValueError(f"nothing to write to {path}: no mesh was given")
    frames = {len(mesh.sequence) for mesh in meshes}
    if len(frames) != 1:
        told = ", ".join(f"{mesh.sequence.name} has {len(mesh.sequence)}" for mesh in meshes)
        raise ValueError(f"meshes that move together need the same number of frames: {told}")
    rates = {mesh.sequence.fps for mesh in meshes}
    if len(rates) != 1 or min(rates) <= 0:
        raise ValueError(f"meshes that move together need one positive frame rate, got {sorted(rates)}")
    together = np.concatenate([mesh.sequence.vertices for mesh in meshes], axis=1)
    document = _Document(rigid_motion(together), rates.pop())
    for mesh in meshes:
        document.add(mesh)
    with atomic_write(path) as part:
        part.write_bytes(document.glb())


# --- formulas


@dataclass(frozen=True)
class RigidMotion:
    """frame_t ~ rotation_t @ first + translation_t, both frames about their centres."""

    rotation: Float[ndarray, "T 3 3"]
    centre: Float[ndarray, "T 3"]


def rigid_motion(vertices: Float32[ndarray, "T N 3"]) -> RigidMotion:
    """The rotation and centre of each frame against the first (Kabsch: least squares over the vertices)."""
    centre = vertices.mean(1, dtype=np.float64)
    around = vertices - centre[:, None]
    left, _, right = np.linalg.svd(np.einsum("tni,nj->tij", around, around[0]))
    flip = np.linalg.det(left @ right)
    left[:, :, 2] *= np.where(flip < 0, -1.0, 1.0)[:, None]
    return RigidMotion(left @ right, centre)


def vertex_normals(vertices: Float[ndarray, "T N 3"], faces: ndarray) -> Float[ndarray, "T N 3"]:
    """Area-weighted unit normals; a vertex without area points up."""
    corners = vertices[:, faces]
    area = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals = np.zeros_like(vertices)
    for frame in range(len(vertices)):
        for axis in range(3):
            weights = np.repeat(area[frame, :, axis], 3)
            normals[frame, :, axis] = np.bincount(faces.ravel(), weights, minlength=vertices.shape[1])
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])


def continuous_quaternions(rotation: Float[ndarray, "T 3 3"]) -> Float[ndarray, "T 4"]:
    """x, y, z, w, without sign jumps, so that a viewer takes the short way between frames."""
    quaternions = Rotation.from_matrix(rotation).as_quat()
    turns = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.cumprod(np.where(turns, -1.0, 1.0))
    return quaternions * np.concatenate([[1.0], signs])[:, None]


# --- the document


class _Document:
    """glTF's JSON and its one binary buffer, as they grow."""

    def __init__(self, rigid: RigidMotion, fps: float):
        self.rigid = rigid
        self.frames = len(rigid.centre)
        quaternions = continuous_quaternions(rigid.rotation)
        self.binary = bytearray()
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "garment-workbench"},
            "extensionsUsed": ["KHR_mesh_quantization"],
            "extensionsRequired": ["KHR_mesh_quantization"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [
                {"name": "z up", "rotation": [float(q) for q in Y_UP], "children": [FIGURE]},
                {
                    "name": "figure",
                    "translation": rigid.centre[0].tolist(),
                    "rotation": quaternions[0].tolist(),
                    "children": [],
                },
            ],
            "meshes": [],
            "materials": [],
            "accessors": [],
            "bufferViews": [],
        }
        self.channels: list[dict[str, Any]] = []
        self.samplers: list[dict[str, Any]] = []
        self.times: int | None = None
        if self.frames > 1:
            times = np.arange(self.frames, dtype=np.float32) / np.float32(fps)
            self.times = self._numbers(times, "SCALAR", bounds=True)
            self._animate(FIGURE, "translation", rigid.centre.astype(np.float32), "VEC3")
            self._animate(FIGURE, "rotation", quaternions.astype(np.float32), "VEC4")

    def add(self, mesh: GltfMesh) -> None:
        sequence = mesh.sequence
        local = np.einsum("tij,tni->tnj", self.rigid.rotation, sequence.vertices - self.rigid.centre[:, None])
        deltas = local - local[0]
        scale = float(max(np.abs(local[0]).max(), np.abs(deltas).max(), 1e-6))
        base = {"POSITION": self._vertices(_quantised(local[0] / scale, 16), bounds=True)}
        names = [f"frame {frame}" for frame in range(self.frames)]
        weights = np.eye(self.frames, dtype=np.float32)  # frame t is target t alone
        positions = deltas / scale
        normals = vertex_normals(local, sequence.faces)
        if mesh.smooth:
            base["NORMAL"] = self._vertices(normals[0].astype(np.float32))
            names.append("normals of the base off")
            weights = np.concatenate([weights, np.ones((self.frames, 1), np.float32)], axis=1)
            positions = np.concatenate([positions, np.zeros_like(positions[:1])])
            normals = np.concatenate([normals, -normals[:1]])
        targets = []
        if self.times is not None:
            targets = [{"POSITION": index} for index in self._targets(_quantised(positions, 16), bounds=True)]
            if mesh.smooth:
                for target, index in zip(targets, self._targets(_quantised(normals, 8))):
                    target["NORMAL"] = index
        primitive: dict[str, Any] = {
            "attributes": base,
            "indices": self._indices(sequence.faces, sequence.vertices.shape[1]),
            "material": len(self.json["materials"]),
        }
        shape: dict[str, Any] = {"name": sequence.name, "primitives": [primitive]}
        if targets:
            primitive["targets"] = targets
            shape |= {"weights": [0.0] * len(targets), "extras": {"targetNames": names}}
        node = {"name": sequence.name, "mesh": len(self.json["meshes"]), "scale": [scale] * 3}
        self.json["materials"].append(_material(mesh))
        self.json["meshes"].append(shape)
        self.json["nodes"].append(node)
        index = len(self.json["nodes"]) - 1
        self.json["nodes"][FIGURE]["children"].append(index)
        if targets:
            self._animate(index, "weights", weights.ravel(), "SCALAR")

    def glb(self) -> bytes:
        if self.channels:
            self.json["animations"] = [{"name": "motion", "channels": self.channels, "samplers": self.samplers}]
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.binary), b"BIN\0") + bytes(self.binary)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _animate(self, node: int, path: str, values: ndarray, kind: str) -> None:
        self.channels.append({"sampler": len(self.samplers), "target": {"node": node, "path": path}})
        output = self._numbers(values, kind)
        self.samplers.append({"input": self.times, "output": output, "interpolation": "LINEAR"})

    def _view(self, content: bytes, **more: int) -> int:
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content), **more}
        )
        self.binary += content + bytes(-len(content) % 4)
        return len(self.json["bufferViews"]) - 1

    def _accessor(self, view: int, offset: int, values: ndarray, kind: str, bounds: bool) -> int:
        component = next(code for code, dtype in ENCODINGS.items() if np.dtype(dtype) == values.dtype)
        entry: dict[str, Any] = {"bufferView": view, "byteOffset": offset, "componentType": component, "type": kind}
        entry["count"] = values.size // WIDTHS[kind]
        if values.dtype.kind == "i":
            entry["normalized"] = True
        if bounds:
            columns = values.reshape(-1, WIDTHS[kind])
            entry |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def _numbers(self, values: ndarray, kind: str, bounds: bool = False) -> int:
        return self._accessor(self._view(values.tobytes()), 0, values, kind, bounds)

    def _indices(self, faces: ndarray, count: int) -> int:
        values = faces.astype("<u2" if count < 65535 else "<u4")
        return self._accessor(self._view(values.tobytes(), target=ELEMENT_BUFFER), 0, values.ravel(), "SCALAR", False)

    def _vertices(self, values: ndarray, bounds: bool = False) -> int:
        return self._targets(values[None], bounds)[0]

    def _targets(self, values: ndarray, bounds: bool = False) -> list[int]:
        """One accessor a frame for (T,N,3), in one view whose rows start at multiples of four bytes."""
        if len(values) == 0:
            return []
        width = 4 if values.dtype.itemsize < 4 else 3
        padded = np.zeros((*values.shape[:2], width), values.dtype)
        padded[:, :, :3] = values
        stride = width * values.dtype.itemsize
        view = self._view(padded.tobytes(), byteStride=stride, target=ARRAY_BUFFER)
        step = stride * values.shape[1]
        return [self._accessor(view, step * t, frame, "VEC3", bounds) for t, frame in enumerate(values)]


def _quantised(values: ndarray, bits: int) -> ndarray:
    top = 2 ** (bits - 1) - 1
    return np.round(np.clip(values, -1.0, 1.0) * top).astype(f"<i{bits // 8}")


def _material(mesh: GltfMesh) -> dict[str, Any]:
    return {
        "name": mesh.sequence.name,
        "doubleSided": mesh.double_sided,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*(float(c) for c in mesh.colour), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": float(mesh.roughness),
        },
    }


# --- reading back


def read_glb(path: str | Path) -> list[MeshSequence]:
    """Read the moving meshes of a .glb that `write_glb` wrote, back in our frame (z up).

    Raises FileNotFoundError, or ValueError for a damaged file or one laid out otherwise.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no .glb at {path}")
    content = path.read_bytes()
    try:
        magic, version, length = struct.unpack_from("<4sII", content)
        size, kind = struct.unpack_from("<I4s", content, 12)
        if magic != b"glTF" or version != 2 or kind != b"JSON" or length != len(content):
            raise ValueError(f"header {magic!r} version {version}, {len(content)} bytes of {length}")
        return _GlbReader(json.loads(content[20 : 20 + size]), content[28 + size :]).sequences()
    except (struct.error, ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{path} is not an animated .glb of ours: {error}") from error


class _GlbReader:
    def __init__(self, document: dict[str, Any], binary: bytes):
        self.json = document
        self.binary = binary

    def sequences(self) -> list[MeshSequence]:
        nodes = self.json["nodes"]
        return [self._sequence(index) for index, node in enumerate(nodes) if "mesh" in node]

    def _sequence(self, index: int) -> MeshSequence:
        node = self.json["nodes"][index]
        primitive = self.json["meshes"][node["mesh"]]["primitives"][0]
        first = self._array(primitive["attributes"]["POSITION"])
        deltas = [self._array(target["POSITION"]) for target in primitive.get("targets", [])]
        figure, moved, shaped = self.json["nodes"][FIGURE], self._channels(FIGURE), self._channels(index)
        translation = moved.get("translation", np.array([figure["translation"]]))
        rotation = Rotation.from_quat(moved.get("rotation", np.array([figure["rotation"]]))).as_matrix()
        local = np.repeat(first[None], len(translation), axis=0)
        if deltas:
            weights = shaped["weights"].reshape(len(translation), -1)
            local += np.einsum("tk,kni->tni", weights, np.stack(deltas))
        vertices = np.einsum("tij,tnj->tni", rotation, local * node["scale"][0]) + translation[:, None]
        faces = self._array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
        times = moved.get("times", np.zeros(1))
        fps = float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else FPS
        return MeshSequence(vertices.astype(np.float32), faces, fps, node["name"])

    def _channels(self, index: int) -> dict[str, ndarray]:
        found: dict[str, ndarray] = {}
        for animation in self.json.get("animations", []):
            for channel in animation["channels"]:
                if channel["target"]["node"] == index:
                    sampler = animation["samplers"][channel["sampler"]]
                    found[channel["target"]["path"]] = self._array(sampler["output"])
                    found["times"] = self._array(sampler["input"]).ravel()
        return found

    def _array(self, index: int) -> ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(ENCODINGS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", width * dtype.itemsize)
        values = np.ndarray(
            (accessor["count"], width), dtype, self.binary, start, strides=(stride, dtype.itemsize)
        ).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values
