"""Scans on disk: PLY and OBJ, with or without normals, and the published npz layout  <->  points (N,3), normals (N,3).

A scan of ours is in metres and z up.  Other units and axes are detected and the remedy is proposed, never guessed; what
had to be made up (normals) is said in the scan's remarks.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import KDTree

from workbench.formats.mesh_sequence import read_mesh
from workbench.geometry.sampling import sample_surface
from workbench.npz import read_npz
from workbench.store import atomic_write

SCAN_POINTS = 40_000  # of a mesh that is sampled; facts.md 2
NEIGHBOURS = 12  # for estimated normals
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
Unit = Literal["m", "cm", "mm"]
Axis = Literal["z", "y"]
TALLEST, SHORTEST = 2.8, 0.5  # metres that the largest extent of a person may have (arms raised, crouching)
LYING = 2.0  # a scan this much deeper than tall is more likely y up than lying down
PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}


@dataclass(frozen=True, eq=False)
class Scan:
    """A point cloud with unit normals; metres, z up.  `remarks`: what was not in the file and had to be made."""

    points: Float32[ndarray, "N 3"]
    normals: Float32[ndarray, "N 3"]
    name: str = "scan"
    remarks: tuple[str, ...] = ()
    estimated: bool = False  # the normals are guesses: their signs may be wrong in places

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class PackedScan:
    """One frame of the published data (CAPE, ReSynth): a scan and the body in it, pelvis-aligned, metres.

    The maps hold the posed body of the frame and the rest body, pixel by pixel (row, column, xyz); zero off the body.
    """

    scan: Scan
    body_vertices: Float32[ndarray, "V 3"]
    transforms: Float32[ndarray, "V 3 3"]  # T of Eq. 2 at each vertex
    position_map: Float32[ndarray, "H W 3"]
    canonical_map: Float32[ndarray, "h w 3"]


# --- PLY and OBJ


def read_scan(
    path: str | Path,
    *,
    unit: Unit = "m",
    up: Axis = "z",
    generator: np.random.Generator | None = None,
    count: int = SCAN_POINTS,
) -> Scan:
    """A scan from a .ply or .obj file.

    Points with normals are taken as they are; a mesh is sampled at `count` points (`generator`: where), with normals of
    its faces; the normals of bare points are estimated from their neighbours, and the scan's remarks say so.
    `unit` and `up` are those of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another format, damaged, empty, NaN; or a size or posture that tells of another unit or axis, with
            the value of `unit` or `up` that would mend it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no scan at {path}; expected a .ply or .obj file")
    kind = path.suffix.lower()
    if kind not in (".ply", ".obj"):
        raise ValueError(f"{path}: scans are read from .ply and .obj files, not {kind or 'files without a suffix'}")
    cloud = _read_ply_points(path) if kind == ".ply" else _read_obj_points(path)
    if len(cloud.points) == 0:
        raise ValueError(f"{path} holds no points")
    bad = int((~np.isfinite(cloud.points)).any(1).sum())
    if bad:
        raise ValueError(f"{path}: {bad} of {len(cloud.points)} points are NaN or infinite; remove them")
    scan = _made_of(path, cloud, count, np.random.default_rng(0) if generator is None else generator)
    require_person_sized(scan.points * UNITS[unit], path.name, unit)
    turned = replace(scan, points=_z_up(scan.points * np.float32(UNITS[unit]), up), normals=_z_up(scan.normals, up))
    require_upright(turned.points, path.name)
    return turned


def require_person_sized(points: Float[ndarray, "N 3"], name: str, unit: Unit = "m") -> None:
    """Raises ValueError, naming the likely unit, unless the cloud is as large as a person; points in metres."""
    extent = float(np.ptp(points, axis=0).max())
    if SHORTEST <= extent <= TALLEST:
        return
    raw = extent / UNITS[unit]
    likely = [other for other, scale in UNITS.items() if SHORTEST <= raw * scale <= TALLEST]
    remedy = (
        f"it looks like {likely[0]}: pass unit='{likely[0]}' (--unit {likely[0]})"
        if likely
        else "expected a person, 0.5 to 2.8 m"
    )
    raise ValueError(f"{name} is {_plain(raw)} {unit} large; {remedy}")


def _plain(value: float) -> str:
    """Three digits, and never 1.59e+03."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def require_upright(points: Float[ndarray, "N 3"], name: str) -> None:
    """Raises ValueError where a cloud is so much deeper than tall that its up axis must be y."""
    _, deep, tall = np.ptp(points, axis=0)
    if deep > LYING * tall:
        raise ValueError(
            f"{name} is {tall:.2f} m tall (z) and {deep:.2f} m deep (y); it looks y-up: pass up='y' (--up y)"
        )


def write_scan(path: str | Path, scan: Scan) -> None:
    """A binary .ply of points with normals."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise ValueError(f"a scan is written as .ply, not as {path.name}")
    fields = ("x", "y", "z", "nx", "ny", "nz")
    header = "".join(f"property float {field}\n" for field in fields)
    rows = np.concatenate([scan.points, scan.normals], 1).astype("<f4")
    with atomic_write(path) as part:
        part.write_bytes(
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(scan)}\n{header}end_header\n".encode()
            + rows.tobytes()
        )


@dataclass(frozen=True, eq=False)
class _Cloud:
    points: Float[ndarray, "N 3"]
    normals: Float[ndarray, "N 3"] | None
    faces: Int[ndarray, "F 3"] | None


def _made_of(path: Path, cloud: _Cloud, count: int, generator: np.random.Generator) -> Scan:
    if cloud.normals is not None and cloud.faces is None:
        length = np.linalg.norm(cloud.normals, axis=1, keepdims=True)
        bad = int((~(length > 1e-6)).sum()) + int(np.isinf(length).sum())
        if bad:
            raise ValueError(f"{path}: {bad} normals are zero, NaN or infinite; remove or recompute them")
        return Scan(cloud.points.astype(np.float32), (cloud.normals / length).astype(np.float32), path.stem)
    if cloud.faces is not None:
        sampled = sample_surface(cloud.points, cloud.faces, count, generator)
        return Scan(
            sampled.point, sampled.normal, path.stem, (f"{count} points were sampled on the mesh of {path.name}",)
        )
    remark = f"{path.name} has no normals: they were estimated from the points, outside guessed from the topmost one"
    return Scan(cloud.points.astype(np.float32), estimate_normals(cloud.points), path.stem, (remark,), estimated=True)


def _z_up(vectors: Float32[ndarray, "N 3"], up: Axis) -> Float32[ndarray, "N 3"]:
    """(x, y, z) with y up and facing +z -> z up and facing -y."""
    return vectors if up == "z" else np.stack([vectors[:, 0], -vectors[:, 2], vectors[:, 1]], 1)


def _read_obj_points(path: Path) -> _Cloud:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if any(line.startswith("f ") for line in lines):
        mesh = read_mesh(path)
        return _Cloud(mesh.vertices, None, mesh.faces)
    try:
        points = [[float(word) for word in line.split()[1:4]] for line in lines if line.startswith("v ")]
        normals = [[float(word) for word in line.split()[1:4]] for line in lines if line.startswith("vn ")]
        rows = np.array(points, float).reshape(-1, 3)
        directions = np.array(normals, float).reshape(-1, 3)
    except ValueError as error:
        raise ValueError(f"{path} is not a readable OBJ: {error}") from error
    return _Cloud(rows, directions if len(directions) == len(rows) and len(rows) else None, None)


def _read_ply_points(path: Path) -> _Cloud:
    """Vertices of a PLY of any kind, with `nx ny nz` where it has them; its faces if it has any."""
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header")
    if not content.startswith(b"ply") or not mark:
        raise ValueError(f"{path} is not a PLY file")
    body = body.partition(b"\n")[2]
    words = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    encoding = next((line[1] for line in words if line[:1] == ["format"]), "")
    elements = [line for line in words if line[:1] in (["element"], ["property"])]
    if not elements or elements[0][:2] != ["element", "vertex"]:
        raise ValueError(f"{path}: expected vertices as the first element of the PLY")
    count = int(elements[0][2])
    end = next((k for k, line in enumerate(elements) if k and line[0] == "element"), len(elements))
    properties = elements[1:end]
    if any(line[1] not in PLY_TYPES for line in properties):
        raise ValueError(f"{path}: its vertices have properties that are no plain numbers")
    names = [line[2] for line in properties]
    if not {"x", "y", "z"} <= set(names):
        raise ValueError(f"{path}: its vertices have {', '.join(names) or 'no properties'}; expected x, y, z")
    table = _ply_table(path, body, encoding, count, [(line[2], PLY_TYPES[line[1]]) for line in properties])
    has_faces = any(line[:2] == ["element", "face"] and line[2] != "0" for line in elements)

    def columns(*keys: str) -> Float[ndarray, "N 3"]:
        return np.stack([table[key].astype(float) for key in keys], 1)

    return _Cloud(
        columns("x", "y", "z"),
        columns("nx", "ny", "nz") if {"nx", "ny", "nz"} <= set(names) else None,
        read_mesh(path).faces if has_faces and count else None,
    )


def _ply_table(
    path: Path, body: bytes, encoding: str, count: int, columns: list[tuple[str, str]]
) -> dict[str, Float[ndarray, "N"]]:
    if encoding == "ascii":
        try:
            numbers = np.array([line.split()[: len(columns)] for line in body.splitlines()[:count]], float)
        except ValueError as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        if numbers.shape != (count, len(columns)) and count:
            raise ValueError(f"{path} is damaged: {len(numbers)} rows of vertices, expected {count}")
        return {name: numbers.reshape(count, len(columns))[:, k] for k, (name, _) in enumerate(columns)}
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(encoding)
    if order is None:
        raise ValueError(f"{path}: unknown PLY format {encoding!r}")
    row = np.dtype([(name, order + kind) for name, kind in columns])
    if len(body) < count * row.itemsize:
        raise ValueError(f"{path} is damaged: {len(body)} bytes of vertices, expected {count * row.itemsize}")
    table = np.frombuffer(body, row, count)
    return {name: table[name] for name, _ in columns}


# --- normals of bare points


def estimate_normals(points: Float[ndarray, "N 3"]) -> Float32[ndarray, "N 3"]:
    """Unit normals of the planes through each point's neighbours, turned to agree along a minimum spanning tree.

    Outside is where the topmost point of each connected part looks upwards.  Source: Hoppe et al. 1992.
    Raises ValueError for fewer points than a plane needs.
    """
    count = len(points)
    if count < NEIGHBOURS + 1:
        raise ValueError(f"normals cannot be estimated from {count} points; expected more than {NEIGHBOURS}")
    around = np.asarray(KDTree(points).query(points, NEIGHBOURS + 1)[1])
    offset = points[around] - points[around].mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    i, j = np.repeat(np.arange(count), NEIGHBOURS), around[:, 1:].ravel()
    agreement = (normals[i] * normals[j]).sum(1)
    cost = 1.0 + 1e-6 - np.abs(agreement)
    tree = minimum_spanning_tree(coo_array((cost, (i, j)), shape=(count, count)).tocsr())
    waiting = np.ones(count, bool)
    for top in np.argsort(-points[:, 2]):
        if not waiting[top]:
            continue
        order, parent = breadth_first_order(tree, top, directed=False)
        waiting[order] = False
        normals[top] *= np.sign(normals[top, 2]) or 1.0
        for child in order[1:]:
            if normals[child] @ normals[parent[child]] < 0:
                normals[child] *= -1
    return normals.astype(np.float32)


# --- the published layout


def read_packed_scan(path: str | Path) -> PackedScan:
    """One frame of CAPE's or ReSynth's packed npz: keys posmap<n>, posmap_canonical<n>, scan_pc, scan_n, body_verts,
    vtransf, scan_name (facts.md 2).

    Raises FileNotFoundError, or ValueError naming what is missing, misshapen or not finite.
    """
    required = ("scan_pc", "scan_n", "body_verts", "vtransf")
    arrays = read_npz(path, "a packed scan", required=required)
    maps = {}
    for what, pattern in (("posmap", r"posmap\d+"), ("posmap_canonical", r"posmap_canonical\d+")):
        keys = [key for key in arrays if re.fullmatch(pattern, key)]
        if len(keys) != 1:
            raise ValueError(f"{path}: expected one array {what}<size>, got {', '.join(sorted(keys)) or 'none'}")
        maps[what] = _finite(path, keys[0], arrays[keys[0]], (None, None, 3))
    vertices = _finite(path, "body_verts", arrays["body_verts"], (None, 3))
    transforms = arrays["vtransf"][..., :3, :3]  # (V,4,4) holds the translation too, which p_i has already
    points = _finite(path, "scan_pc", arrays["scan_pc"], (None, 3))
    if not len(points):
        raise ValueError(f"{path}: scan_pc holds no points")
    return PackedScan(
        scan=Scan(
            points,
            _finite(path, "scan_n", arrays["scan_n"], (len(points), 3)),
            str(arrays["scan_name"]) if "scan_name" in arrays else Path(path).stem,
        ),
        body_vertices=vertices,
        transforms=_finite(path, "vtransf", transforms, (len(vertices), 3, 3)),
        position_map=maps["posmap"],
        canonical_map=maps["posmap_canonical"],
    )


def write_packed_scan(path: str | Path, packed: PackedScan) -> None:
    """The same layout, its maps named by their size."""
    with atomic_write(path) as part:
        arrays = {
            f"posmap{len(packed.position_map)}": packed.position_map,
            f"posmap_canonical{len(packed.canonical_map)}": packed.canonical_map,
            "scan_pc": packed.scan.points,
            "scan_n": packed.scan.normals,
            "scan_name": np.array(packed.scan.name),
            "body_verts": packed.body_vertices,
            "vtransf": packed.transforms,
        }
        np.savez_compressed(part, **arrays)  # pyright: ignore[reportArgumentType]  (numpy's stub)


def _finite(path: str | Path, key: str, array: ndarray, shape: tuple[int | None, ...]) -> ndarray:
    fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape))
    if not fits or array.dtype.kind not in "fiu":
        wanted = ", ".join("any" if side is None else str(side) for side in shape)
        raise ValueError(f"{path}: {key} is {array.dtype} {array.shape}, expected numbers of shape ({wanted})")
    if not np.isfinite(array).all():
        raise ValueError(f"{path}: {key} holds NaN or infinite values")
    return array.astype(np.float32)
