"""Scene -> what a browser reads: a header (JSON) and typed arrays, for both browser faces, live and page.

Positions and scalars become whole numbers of 16 bits: value = low + step * code, wrong by at most half a step; the
last code means NaN.  Marks are exact: one bit a vertex.  An array that several layers share is sent once.
"""

import base64
import hashlib
import json
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt
from numpy import ndarray

from widgets.colour import colour_table
from widgets.scene import Arrows, Camera, Layer, Mesh, Scalars, Scene, View, marks_of, positions_of
from workbench.collisions.sequences import spanning_tree

CODES = 65534  # the largest code of a number; 65535 is NaN
NOT_A_NUMBER = 65535
LARGEST = 512e6  # bytes: more than a browser tab is sure to hold
LEVEL = 6  # of deflate: a third of the time of 9, one percent more bytes
MANY_VERTICES = 400_000  # more than software WebGL turns fluently


@dataclass(frozen=True)
class Wire:
    """`header` names the arrays by key; `arrays` holds them; `trees` the spanning tree of moving meshes, by key."""

    header: dict[str, Any]
    arrays: dict[str, ndarray]
    faces_of: dict[str, ndarray]  # key of moving positions -> faces, for the packing


@dataclass(frozen=True)
class Quantised:
    codes: UInt[ndarray, "*S"]
    low: list[float]
    step: float


@dataclass
class _Encoder:
    least_step: float
    arrays: dict[str, ndarray] = field(default_factory=dict)
    faces_of: dict[str, ndarray] = field(default_factory=dict)
    known: dict[tuple[int, ...], dict[str, Any]] = field(default_factory=dict)
    kept: list[Any] = field(default_factory=list)  # what `known` names by identity stays alive
    notices: list[str] = field(default_factory=list)
    maps: dict[str, str] = field(default_factory=dict)


def encode(scene: Scene, aspect: float = 1.0, least_step: float = 0.0) -> Wire:
    """`aspect` is a view's width over its height; `least_step` (metres) the finest that positions need to be.

    Errors: ValueError for a scene without views, or one too large for a browser.
    """
    if not scene.views:
        raise ValueError("there is nothing to draw: the scene has no view")
    made = _Encoder(least_step)
    views = [_view(made, view, f"{index}") for index, view in enumerate(scene.views)]
    size = sum(array.nbytes for array in made.arrays.values())
    if size > LARGEST:
        raise ValueError(
            f"this scene is {size / 1e6:.0f} MB for a browser, which holds {LARGEST / 1e6:.0f}: show fewer of its "
            f"{scene.frames} frames, such as every {int(np.ceil(size / LARGEST))}th"
        )
    header = {
        "views": views,
        "columns": scene.columns or len(scene.views),
        "frames": scene.frames,
        "fps": scene.fps,
        "background": list(scene.background),
        "camera": _camera(_shared_camera(made, scene, aspect)),
        "notices": made.notices,
        "arrays": {key: {"type": str(array.dtype), "shape": list(array.shape)} for key, array in made.arrays.items()},
    }
    return Wire(header | {"signature": _signature(header)}, made.arrays, made.faces_of)


def quantise(
    values: Float[ndarray, "*S"], low: Float[ndarray, "*c"], high: Float[ndarray, "*c"], least_step: float
) -> Quantised:
    """Whole numbers of 16 bits between `low` and `high`; one step for all components, at least `least_step`."""
    step = max(float(np.max(high - low)) / CODES, least_step, 1e-12)
    with np.errstate(invalid="ignore"):
        scaled = np.rint((values - low) / step)
    codes = np.where(np.isfinite(scaled), np.clip(scaled, 0, CODES), NOT_A_NUMBER)
    return Quantised(codes.astype(np.uint16), np.atleast_1d(low).astype(float).tolist(), step)


def _view(made: _Encoder, view: View, key: str) -> dict[str, Any]:
    layers = [_layer(made, layer, f"{key}.{index}") for index, layer in enumerate(view.layers)]
    return {"title": view.title, "camera": view.camera and _camera(view.camera), "layers": layers}


def _layer(made: _Encoder, layer: Layer, key: str) -> dict[str, Any]:
    common = {"name": layer.name or f"layer {key.split('.')[1]}", "colour": list(layer.colour)}
    if isinstance(layer, Arrows):
        ends = np.concatenate([layer.starts, layer.starts + layer.vectors], axis=-2)
        return common | {"kind": "arrows", "positions": _positions(made, ends, None, key, common["name"])}
    if isinstance(layer, Mesh):
        drawn = {
            "kind": "mesh",
            "positions": _positions(made, layer.vertices, layer.faces, key, common["name"]),
            "faces": _shared(made, (id(layer.faces),), layer.faces, f"{key}.faces", lambda a: a.astype(np.uint32)),
            "opacity": layer.opacity,
            "smooth": layer.smooth,
            "edges": layer.edges,
        }
        if layer.regions is not None:
            labels = layer.regions.labels.astype(np.int16)
            made.arrays[f"{key}.regions"] = labels
            drawn["regions"] = {"key": f"{key}.regions", "names": list(layer.regions.names)}
    else:
        drawn = {
            "kind": "points",
            "positions": _positions(made, layer.positions, None, key, common["name"]),
            "size": layer.size,
            "onTop": layer.on_top,
            "radius": layer.radius,
        }
        if layer.normals is not None:
            with np.errstate(invalid="ignore"):
                signs = np.nan_to_num(np.rint(127 * layer.normals))
            made.arrays[f"{key}.normals"] = _framed(np.clip(signs, -127, 127).astype(np.int8), 2)
            drawn["normals"] = f"{key}.normals"
    marks = marks_of(layer)
    if marks is not None:
        made.arrays[f"{key}.marks"] = np.packbits(_framed(marks, 1), axis=-1, bitorder="little")
        drawn["marks"] = f"{key}.marks"
        drawn["markName"] = layer.mark_name
    shown = () if layer.scalars is None else (layer.scalars,)
    drawn["plain"] = layer.scalars is None
    drawn["scalars"] = [_scalars(made, s, f"{key}.scalars{i}") for i, s in enumerate(shown + layer.choices)]
    return common | drawn


def _positions(made: _Encoder, array: ndarray, faces: ndarray | None, key: str, name: str) -> dict[str, Any]:
    known = made.known.get((id(array),))
    if known is not None:
        return known
    finite = np.isfinite(array).all(axis=-1)
    lacking = np.atleast_2d(~finite).sum(axis=1)  # a frame
    if lacking.any():
        where = f", first in frame {int(np.flatnonzero(lacking)[0])}" if len(lacking) > 1 else ""
        made.notices.append(f"{name}: {int(lacking.max())} vertices are NaN or infinite{where}; they are not drawn")
    if array.shape[-2] > MANY_VERTICES:
        made.notices.append(
            f"{name}: {array.shape[-2]:,} vertices; turning it may be slow without a graphics card, decimate to look"
        )
    points = array.reshape(-1, 3)[finite.reshape(-1)]
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.ones(3))
    coded = quantise(array, low, high, made.least_step)
    made.arrays[f"{key}.positions"] = _framed(coded.codes, 2)
    if faces is not None:
        made.faces_of[f"{key}.positions"] = faces
    described = {"key": f"{key}.positions", "low": coded.low, "step": coded.step}
    made.known[(id(array),)] = described
    made.kept.append(array)
    return described


def _scalars(made: _Encoder, scalars: Scalars, key: str) -> dict[str, Any]:
    finite = scalars.values[np.isfinite(scalars.values)]
    low, high = (np.array(finite.min()), np.array(finite.max())) if len(finite) else (np.array(0.0), np.array(1.0))
    if scalars.categories:
        coded = Quantised(quantise(scalars.values, np.array(0.0), np.array(float(CODES)), 1.0).codes, [0.0], 1.0)
    else:
        coded = quantise(scalars.values, low, high, 0.0)
    described = _shared(made, (id(scalars.values),), scalars.values, key, lambda _: _framed(coded.codes, 1))
    table = np.rint(255 * colour_table(scalars)).astype(np.uint8)
    name = hashlib.sha256(table.tobytes()).hexdigest()[:12]
    made.arrays.setdefault(f"map.{name}", table)
    return {
        "key": described,
        "low": coded.low[0],
        "step": coded.step,
        "name": scalars.name,
        "unit": scalars.unit,
        "limits": list(scalars.range()),
        "map": f"map.{name}",
        "threshold": scalars.threshold,
        "categories": list(scalars.categories),
        "legend": scalars.legend,
    }


def _shared(made: _Encoder, identity: tuple[int, ...], array: ndarray, key: str, convert: Any) -> str:
    """The key of an array that several layers may share."""
    if identity not in made.known:
        made.arrays[key] = convert(array)
        made.known[identity] = {"key": key}
        made.kept.append(array)
    return made.known[identity]["key"]


def _framed(array: Shaped[ndarray, "..."], still: int) -> Shaped[ndarray, "..."]:
    """With a leading axis of frames, one where nothing moves."""
    return np.ascontiguousarray(array if array.ndim > still else array[None])


def _shared_camera(made: _Encoder, scene: Scene, aspect: float) -> Camera:
    layers = [layer for view in scene.views for layer in view.layers]
    if scene.camera is None and not any(np.isfinite(positions_of(layer)).all(1).any() for layer in layers):
        made.notices.append("there is nothing to look at: the scene has no finite point")
        return Camera((0.0, -3.0, 1.0), (0.0, 0.0, 1.0))
    return scene.resolved_camera(aspect)


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "position": list(camera.position),
        "target": list(camera.target),
        "up": list(camera.up),
        "angle": camera.view_angle,
    }


def _signature(header: dict[str, Any]) -> str:
    """What must agree for new arrays to take the place of old ones without building the view anew."""
    parts = [
        (view["title"] is not None, layer["kind"], layer["name"], layer.get("marks"), layer.get("opacity"))
        + tuple((s["name"], s["map"], s["key"]) for s in layer.get("scalars", ()))
        for view in header["views"]
        for layer in view["layers"]
    ]
    shapes = {key: array["shape"] for key, array in header["arrays"].items()}
    text = json.dumps([parts, shapes, header["columns"], header["frames"], len(header["views"])])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


# packing: fewer bytes for a file


def packed(wire: Wire) -> tuple[dict[str, Any], bytes]:
    """Header and one deflated blob.

    Moving positions are predicted, `as in the frame before` and `moved as its neighbour in the mesh did`, and every
    array is laid out by the significance of its bytes: what is left is small, and mostly zero.
    """
    pieces: list[bytes] = []
    described: dict[str, Any] = {}
    for key, array in wire.arrays.items():
        entry = dict(wire.header["arrays"][key])
        if key in wire.faces_of and array.shape[0] > 1:
            tree = spanning_tree(wire.faces_of[key], array.shape[1])
            order = np.concatenate(tree.levels)
            entry |= {"coding": "moves", "tree": f"{key}.tree"}
            rows = np.stack([order, tree.parent[order]], axis=1).astype(np.int32)
            described[f"{key}.tree"] = {"type": "int32", "shape": list(rows.shape), "coding": "differences"}
            pieces.append(planes(differences(rows)))
            pieces.append(planes(moves(array, tree.parent)))
        elif array.dtype.itemsize > 1 and array.ndim > 1:
            entry["coding"] = "differences"
            pieces.append(planes(differences(array)))
        else:
            entry["coding"] = "plain"
            pieces.append(array.tobytes())
        described[key] = entry
    return wire.header | {"arrays": described}, zlib.compress(b"".join(pieces), LEVEL)


def moves(codes: UInt[ndarray, "T N C"], parent: Int[ndarray, "N"]) -> UInt[ndarray, "C N T"]:
    """What the two predictions leave, modulo 2^16, small magnitudes first."""
    moved = np.diff(codes, axis=0, prepend=np.zeros_like(codes[:1]))
    left = moved.copy()
    hanging = parent >= 0
    left[:, hanging] -= moved[:, parent[hanging]]
    return zigzag(np.ascontiguousarray(left.transpose(2, 1, 0)))


def differences(array: Shaped[ndarray, "R ..."]) -> UInt[ndarray, "R ..."]:
    """Each row less the one before, modulo the width of the type, small magnitudes first."""
    unsigned = array.view(f"u{array.dtype.itemsize}")
    return zigzag(np.diff(unsigned, axis=0, prepend=np.zeros_like(unsigned[:1])))


def zigzag(wrapped: UInt[ndarray, "*S"]) -> UInt[ndarray, "*S"]:
    """0, -1, 1, -2 ... -> 0, 1, 2, 3 ..., for differences modulo the width of the type."""
    signed = wrapped.view(f"i{wrapped.dtype.itemsize}")
    return ((signed << 1) ^ (signed >> (8 * wrapped.dtype.itemsize - 1))).view(wrapped.dtype)


def planes(array: UInt[ndarray, "..."]) -> bytes:
    """All bytes of one significance together."""
    return np.moveaxis(np.ascontiguousarray(array)[..., None].view(np.uint8), -1, 0).tobytes()


def as_base64(blob: bytes) -> str:
    return base64.b64encode(blob).decode("ascii")


def raw_bytes(arrays: Iterable[ndarray]) -> list[bytes]:
    """Every array as it lies in memory, little-endian."""
    return [np.ascontiguousarray(array).tobytes() for array in arrays]
