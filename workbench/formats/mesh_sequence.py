"""Moving meshes on disk: npz, OBJ or PLY folders, PC2 beside an OBJ  <->  vertices (T,N,3), faces (F,3).

Frames are ours (metres, z up) and are written as they are: a reader of the files sets its own axes.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from workbench.npz import read_npz
from workbench.store import atomic_write

FPS = 30.0  # the paper's frame rate (section 6), for formats that hold none
DRESSED_KEYS = ("body_vertices", "body_faces", "garment_vertices", "garment_faces")
PC2_HEADER = struct.Struct("<12siiffi")  # magic, version, points, first frame, sample rate, samples


@dataclass(frozen=True)
class Mesh:
    """One triangle mesh, metres."""

    vertices: Float32[ndarray, "N 3"]
    faces: Int64[ndarray, "F 3"]


@dataclass(frozen=True)
class MeshSequence:
    """One mesh that moves: T frames of the same N vertices, metres."""

    vertices: Float32[ndarray, "T N 3"]
    faces: Int64[ndarray, "F 3"]
    fps: float = FPS
    name: str = "mesh"

    def __len__(self) -> int:
        return len(self.vertices)


@dataclass(frozen=True)
class DressedSequence:
    """A body and a garment that move together: what `workbench tryon` writes and `workbench export` reads."""

    body: MeshSequence
    garment: MeshSequence


# --- one mesh


def read_mesh(path: str | Path) -> Mesh:
    """Read an .obj or .ply; vertices keep their order, polygons are split into fans.

    Raises FileNotFoundError, or ValueError when it is damaged or holds no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no mesh file at {path}")
    readers: dict[str, Callable[[Path], Mesh]] = {".obj": _read_obj, ".ply": _read_ply}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path} is no mesh file: expected .obj or .ply")
    mesh = reader(path)
    _check_mesh(path, mesh.vertices, mesh.faces)
    return mesh


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write an .obj or a binary .ply, by the path's suffix."""
    path = Path(path)
    writers: dict[str, Callable[[Mesh], bytes]] = {".obj": _obj_bytes, ".ply": _ply_bytes}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"cannot write a mesh to {path}: expected .obj or .ply")
    with atomic_write(path) as part:
        part.write_bytes(writer(mesh))


def _read_obj(path: Path) -> Mesh:
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
                if len(vertices[-1]) != 3:
                    raise ValueError("a vertex needs three numbers")
            elif words[:1] == ["f"]:
                corners = [int(word.partition("/")[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners:
                    raise ValueError("a face needs three vertices, counted from 1")
                # negative numbers count back from the last vertex
                corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                faces += [(corners[0], b, c) for b, c in zip(corners[1:], corners[2:])]
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
    return Mesh(np.array(vertices, np.float32).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3))


def _read_ply(path: Path) -> Mesh:
    import trimesh  # slow to import

    try:
        # any failure of the parser means a file that it cannot read
        loaded = trimesh.load_mesh(path, process=False)
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    except (ValueError, TypeError, LookupError, AttributeError, EOFError, OSError, struct.error) as error:
        raise ValueError(f"{path} is not a readable PLY mesh ({type(error).__name__}: {error})") from error
    return Mesh(vertices.astype(np.float32).reshape(-1, 3), faces.astype(np.int64).reshape(-1, 3))


def _obj_bytes(mesh: Mesh) -> bytes:
    # nine digits return every float32 exactly
    vertices = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in mesh.vertices.tolist())
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist())
    return (vertices + faces).encode()


def _ply_bytes(mesh: Mesh) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    return header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


# --- a mesh that moves


def read_mesh_sequence(path: str | Path, fps: float | None = None) -> MeshSequence:
    """Read one moving mesh: a folder of .obj or .ply files (by name), a .pc2 with an .obj of the same name beside it,
    or an .npz with `vertices (T,N,3)`, `faces (F,3)` and perhaps `fps`.

    `fps` is for formats that hold none (and overrides the one in an npz).
    Raises FileNotFoundError, or ValueError when frames disagree or a file is damaged.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, FPS if fps is None else fps)
    if not path.exists():
        raise FileNotFoundError(f"no mesh sequence at {path}")
    if path.suffix.lower() == ".pc2":
        return _read_pc2(path, FPS if fps is None else fps)
    if path.suffix.lower() == ".npz":
        arrays = read_npz(path, "a mesh sequence", required=("vertices", "faces"))
        return _sequence_of(path, arrays, "vertices", "faces", fps, path.stem)
    raise ValueError(f"{path} is no mesh sequence: expected a folder of .obj or .ply files, a .pc2 or an .npz")


def write_mesh_sequence(path: str | Path, sequence: MeshSequence) -> None:
    """Write one moving mesh, by the path's suffix: .npz, .pc2 (its .obj beside it), none for a folder of .obj files."""
    path = Path(path)
    _check_sequence(path, sequence.vertices, sequence.faces)
    if path.suffix.lower() == ".npz":
        with atomic_write(path) as part:
            np.savez_compressed(part, vertices=sequence.vertices, faces=sequence.faces, fps=np.float64(sequence.fps))
    elif path.suffix.lower() == ".pc2":
        _write_pc2(path, sequence)
    elif not path.suffix:
        write_mesh_folder(path, sequence, ".obj")
    else:
        raise ValueError(f"cannot write a mesh sequence to {path}: expected .npz, .pc2 or a folder")


def write_mesh_folder(folder: str | Path, sequence: MeshSequence, suffix: str) -> list[Path]:
    """One file a frame, `name_0000.obj` and so on; `suffix` is .obj or .ply."""
    folder = Path(folder)
    width = max(4, len(str(len(sequence) - 1)))
    paths = [folder / f"{sequence.name}_{frame:0{width}d}{suffix}" for frame in range(len(sequence))]
    for frame, path in zip(sequence.vertices, paths):
        write_mesh(path, Mesh(frame, sequence.faces))
    return paths


def _read_folder(folder: Path, fps: float) -> MeshSequence:
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".obj", ".ply"))
    if not paths:
        raise ValueError(f"{folder} holds no .obj or .ply files")
    first = read_mesh(paths[0])
    frames = [first.vertices]
    for path in paths[1:]:
        mesh = read_mesh(path)
        if len(mesh.vertices) != len(first.vertices) or not np.array_equal(mesh.faces, first.faces):
            raise ValueError(
                f"{path} has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces that are not those of "
                f"{paths[0].name} ({len(first.vertices)}, {len(first.faces)}): a sequence keeps one topology"
            )
        frames.append(mesh.vertices)
    return MeshSequence(np.stack(frames), first.faces, float(fps), folder.name)


def _read_pc2(path: Path, fps: float) -> MeshSequence:
    topology = path.with_suffix(".obj")
    if not topology.is_file():
        raise FileNotFoundError(f"{path} holds no faces: put the mesh beside it as {topology.name}")
    mesh = read_mesh(topology)
    content = path.read_bytes()
    if len(content) < PC2_HEADER.size or not content.startswith(b"POINTCACHE2"):
        raise ValueError(f"{path} is not a PC2 point cache")
    _, _, points, _, _, samples = PC2_HEADER.unpack_from(content)
    if points != len(mesh.vertices):
        raise ValueError(f"{path} moves {points} points, but {topology.name} has {len(mesh.vertices)} vertices")
    expected = PC2_HEADER.size + 12 * points * samples
    if samples < 1 or len(content) != expected:
        raise ValueError(f"{path} is damaged: {len(content)} bytes, expected {expected} for {samples} frames")
    vertices = np.frombuffer(content, "<f4", offset=PC2_HEADER.size).reshape(samples, points, 3).astype(np.float32)
    _check_sequence(path, vertices, mesh.faces)
    return MeshSequence(vertices, mesh.faces, float(fps), path.stem)


def _write_pc2(path: Path, sequence: MeshSequence) -> None:
    frames, points = sequence.vertices.shape[:2]
    write_mesh(path.with_suffix(".obj"), Mesh(sequence.vertices[0], sequence.faces))
    with atomic_write(path) as part:
        header = PC2_HEADER.pack(b"POINTCACHE2\0", 1, points, 0.0, 1.0, frames)
        part.write_bytes(header + sequence.vertices.astype("<f4").tobytes())


# --- a body and a garment


def read_dressed_sequence(path: str | Path) -> DressedSequence:
    """Read an .npz with `body_vertices (T,V,3)`, `body_faces`, `garment_vertices (T,N,3)`, `garment_faces`, `fps`.

    Raises FileNotFoundError, or ValueError when an array is absent, the frame counts differ or the file is damaged.
    """
    path = Path(path)
    arrays = read_npz(path, "a dressed sequence", required=DRESSED_KEYS)
    dressed = DressedSequence(
        _sequence_of(path, arrays, "body_vertices", "body_faces", None, "body"),
        _sequence_of(path, arrays, "garment_vertices", "garment_faces", None, "garment"),
    )
    if len(dressed.body) != len(dressed.garment):
        raise ValueError(f"{path}: the body has {len(dressed.body)} frames, the garment {len(dressed.garment)}")
    return dressed


def write_dressed_sequence(path: str | Path, dressed: DressedSequence, **more: ndarray) -> None:
    """Write the .npz that `read_dressed_sequence` reads; `more` are further arrays (canonical, latent)."""
    with atomic_write(path) as part:
        np.savez_compressed(
            part,
            body_vertices=dressed.body.vertices,
            body_faces=dressed.body.faces,
            garment_vertices=dressed.garment.vertices,
            garment_faces=dressed.garment.faces,
            fps=np.float64(dressed.garment.fps),
            **more,  # pyright: ignore[reportArgumentType]  (numpy's stub takes the rest for its one option)
        )


def _sequence_of(
    path: Path, arrays: dict[str, ndarray], vertices_key: str, faces_key: str, fps: float | None, name: str
) -> MeshSequence:
    vertices, faces = arrays[vertices_key], arrays[faces_key]
    if vertices.ndim != 3 or vertices.shape[-1] != 3 or vertices.dtype.kind not in "fiu":
        raise ValueError(f"{path}: {vertices_key} is {vertices.dtype} {vertices.shape}, expected numbers (T, N, 3)")
    if faces.ndim != 2 or faces.shape[-1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(f"{path}: {faces_key} is {faces.dtype} {faces.shape}, expected whole numbers (F, 3)")
    rate = float(fps if fps is not None else arrays.get("fps", FPS))
    vertices, faces = vertices.astype(np.float32), faces.astype(np.int64)
    _check_sequence(path, vertices, faces)
    return MeshSequence(vertices, faces, rate, name)


def _check_sequence(path: Path, vertices: ndarray, faces: ndarray) -> None:
    if len(vertices) == 0:
        raise ValueError(f"{path} has no frames")
    _check_mesh(path, vertices, faces)


def _check_mesh(path: Path, vertices: ndarray, faces: ndarray) -> None:
    count = vertices.shape[-2]
    if count == 0 or len(faces) == 0:
        raise ValueError(f"{path} holds {count} vertices and {len(faces)} faces: expected a mesh")
    finite = np.isfinite(vertices).all(axis=-1)
    if not finite.all():
        bad = np.argwhere(~np.atleast_2d(finite))
        frame, vertex = bad[0].tolist()
        raise ValueError(
            f"{path} holds NaN or infinite coordinates: {len(bad)} vertices in {len(np.unique(bad[:, 0]))} frames, "
            f"first vertex {vertex} in frame {frame}"
        )
    if faces.min() < 0 or faces.max() >= count:
        worst = int(faces.max() if faces.max() >= count else faces.min())
        raise ValueError(f"{path}: faces index vertex {worst}, but the mesh has {count} vertices")
