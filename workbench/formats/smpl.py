"""SMPL-format body files (Loper et al. 2015), npz or pkl, in -> plain arrays out.  No code in the file is ever run.

Published files of this family are pickles that hold chumpy expressions and scipy matrices.  Unpickling runs whatever
the file names, so this reader lets a file name inert stand-ins only: not even numpy's own reconstruction is called,
because a forged dtype reads memory it should not.
"""

import io
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray
from scipy import sparse

from workbench.npz import read_npz

KEYS = ("v_template", "shapedirs", "posedirs", "weights", "J_regressor", "kintree_table", "f")


@dataclass(frozen=True)
class SmplArrays:
    """A body of the SMPL family as plain arrays, metres, in the file's own frame (y up for SMPL)."""

    template: Float32[ndarray, "V 3"]
    shape_directions: Float32[ndarray, "V 3 K"]
    pose_directions: Float32[ndarray, "V 3 P"]  # P = 9(J-1), over the entries of (R - I) of all joints but the root
    weights: Float32[ndarray, "V J"]
    joint_regressor: Float32[ndarray, "J V"]
    parents: tuple[int, ...]  # -1 for the root
    faces: Int64[ndarray, "F 3"]


def read_smpl(path: str | Path) -> SmplArrays:
    """Read an SMPL-format .npz or .pkl.

    Raises FileNotFoundError when there is no such file, ValueError when it is damaged, lacks an array, disagrees with
    itself, or is a pickle that names anything but arrays.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no body file at {path}")
    readers: dict[str, Callable[[Path], dict[str, ndarray]]] = {".npz": _read_npz, ".pkl": _read_pickle}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path} is no SMPL-format file: expected .npz or .pkl, got {path.suffix or 'no suffix'!r}")
    return _checked(path, reader(path))


def _read_npz(path: Path) -> dict[str, ndarray]:
    arrays = read_npz(path, "an SMPL-format body", required=KEYS)
    return {key: arrays[key] for key in KEYS}


def _read_pickle(path: Path) -> dict[str, ndarray]:
    try:
        content = _InertUnpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
        if not isinstance(content, Mapping):
            raise ValueError(f"it holds a {type(content).__name__}, expected a dictionary of arrays")
        return {key: _array_of(content[key]) for key in KEYS if key in content}
    except (pickle.UnpicklingError, EOFError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"{path} is not a readable SMPL pickle: {error or type(error).__name__}") from error
    except (ImportError, OverflowError, MemoryError, RecursionError) as error:
        raise ValueError(f"{path} is not a readable SMPL pickle: {type(error).__name__}") from error


def _checked(path: Path, arrays: dict[str, ndarray]) -> SmplArrays:
    missing = [key for key in KEYS if key not in arrays]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}: expected the arrays {', '.join(KEYS)}")
    for key in ("v_template", "shapedirs", "posedirs", "weights", "J_regressor"):
        if arrays[key].dtype.kind not in "fiu":
            raise ValueError(f"{path}: {key} holds {arrays[key].dtype}, expected numbers")
        if not np.isfinite(arrays[key]).all():
            raise ValueError(f"{path}: {key} holds NaN or infinity; the file is damaged")
    vertices, joints = len(arrays["v_template"]), arrays["kintree_table"].shape[-1]
    expected = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, None),
        "posedirs": (vertices, 3, None),
        "weights": (vertices, joints),
        "J_regressor": (joints, vertices),
        "kintree_table": (2, joints),
        "f": (None, 3),
    }
    for key, shape in expected.items():
        got = arrays[key].shape
        if len(got) != len(shape) or any(want not in (None, have) for want, have in zip(shape, got)):
            wanted = ", ".join("any" if size is None else str(size) for size in shape)
            raise ValueError(f"{path}: {key} has shape {got}, expected ({wanted})")
    if arrays["posedirs"].shape[2] != 9 * (joints - 1):
        got = arrays["posedirs"].shape[2]
        raise ValueError(f"{path}: posedirs has {got} directions, expected {9 * (joints - 1)} for {joints} joints")
    faces = arrays["f"].astype(np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= vertices):
        raise ValueError(f"{path}: faces index vertex {faces.max()}, but the body has {vertices} vertices")
    parents = [int(parent) for parent in arrays["kintree_table"][0].astype(np.int64)]
    parents[0] = -1  # files hold 2**32 - 1 here
    if any(not 0 <= parent < joint for joint, parent in enumerate(parents) if joint > 0):
        raise ValueError(f"{path}: kintree_table has parents {parents}; each must come before its child")
    return SmplArrays(
        template=arrays["v_template"].astype(np.float32),
        shape_directions=arrays["shapedirs"].astype(np.float32),
        pose_directions=arrays["posedirs"].astype(np.float32),
        weights=arrays["weights"].astype(np.float32),
        joint_regressor=arrays["J_regressor"].astype(np.float32),
        parents=tuple(parents),
        faces=faces,
    )


# --- stand-ins: what a file may name, and what it gets instead


class _Inert:
    """Keeps what a pickle hands it (arguments, state) and does nothing with it."""

    def __init__(self, *arguments: Any):
        self.arguments = arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Dtype(_Inert):
    """For numpy.dtype: arguments ('f8', ...), state (version, byte order, ...)."""


class _Array(_Inert):
    """For numpy.ndarray: state (version, shape, dtype, fortran order, bytes or list)."""


class _Chumpy(_Inert):
    """For any chumpy class: state is its dictionary of attributes."""


class _Sparse(_Inert):
    """For any scipy.sparse class: state is its dictionary of attributes."""


class _Class(_Inert):
    """For classes that only ever appear as an argument (object, numpy.ndarray)."""


def _reconstruct_array(*_subtype_shape_kind: Any) -> _Array:
    return _Array()


def _reconstruct_object(kind: Any, *_base_and_state: Any) -> Any:
    if not (isinstance(kind, type) and issubclass(kind, _Inert)):
        raise ValueError("it reconstructs something that is no array")
    return kind()


def _array_from_buffer(buffer: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    array = _Array()
    array.state = (1, shape, dtype, order == "F", buffer)
    return array


def _scalar(dtype: Any, content: Any = b"") -> _Array:
    return _array_from_buffer(content, dtype, (), "C")


def _latin1(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise ValueError("it encodes something that is no array's bytes")
    return text.encode("latin1")


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("builtins", "object"): _Class,
    ("__builtin__", "object"): _Class,
    ("copyreg", "_reconstructor"): _reconstruct_object,
    ("copy_reg", "_reconstructor"): _reconstruct_object,
    ("collections", "OrderedDict"): dict,
    ("builtins", "set"): set,
    ("__builtin__", "set"): set,
    ("_codecs", "encode"): _latin1,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _reconstruct_array for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _array_from_buffer for core in ("core", "_core")},
}


class _InertUnpickler(pickle.Unpickler):
    """Gives every name in the file a stand-in, or refuses the file.  Nothing is imported."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        admitted = _ADMITTED.get((module_name, global_name))
        if admitted is not None:
            return admitted
        if module_name.partition(".")[0] == "chumpy":
            return _Chumpy
        if module_name == "scipy.sparse" or module_name.startswith("scipy.sparse."):
            return _Sparse
        raise pickle.UnpicklingError(
            f"it names {module_name}.{global_name}, which could run code; only arrays are read. "
            f"Convert the file to npz where you trust it"
        )


# --- stand-ins -> arrays


def _array_of(thing: Any) -> ndarray:
    """The array that a stand-in stands for."""
    if isinstance(thing, _Array):
        return _plain_array(thing)
    if isinstance(thing, _Chumpy):
        return _chumpy_array(thing)
    if isinstance(thing, _Sparse):
        return _sparse_array(thing)
    array = np.asarray(thing)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"it holds a {type(thing).__name__} where an array of numbers was expected")
    return array


def _plain_array(array: _Array) -> ndarray:
    if not isinstance(array.state, tuple) or len(array.state) != 5:
        raise ValueError("it holds an array without content")
    _, shape, dtype, fortran, content = array.state
    if isinstance(content, str):  # Python 2 wrote bytes as text
        content = content.encode("latin1")
    if not isinstance(content, bytes | bytearray):
        raise ValueError("it holds an array of objects where numbers were expected")
    return np.frombuffer(bytes(content), _plain_dtype(dtype)).reshape(shape, order="F" if fortran else "C")


def _plain_dtype(dtype: Any) -> np.dtype:
    name = dtype.arguments[0] if isinstance(dtype, _Dtype) and dtype.arguments else None
    if not isinstance(name, str) or name[:1] not in tuple("fiub") or not name[1:].isdigit():
        raise ValueError(f"it holds an array of type {name!r}, expected numbers")
    order = dtype.state[1] if isinstance(dtype.state, tuple) else "="
    return np.dtype(name).newbyteorder(order if order in ("<", ">") else "=")


def _chumpy_array(expression: _Chumpy) -> ndarray:
    """chumpy.Ch is its `x`; chumpy's Select is `a.ravel()[idxs]` in its preferred shape.  Nothing else is evaluated."""
    state = expression.state if isinstance(expression.state, Mapping) else {}
    if "x" in state:
        return _array_of(state["x"])
    if "a" in state and "idxs" in state:
        chosen = _array_of(state["a"]).ravel()[_array_of(state["idxs"]).astype(np.int64)]
        return chosen.reshape(tuple(state["preferred_shape"])) if "preferred_shape" in state else chosen
    raise ValueError(f"it holds a chumpy expression of {sorted(state)}, which is not evaluated here: save it as npz")


def _sparse_array(matrix: _Sparse) -> ndarray:
    state = matrix.state if isinstance(matrix.state, Mapping) else {}
    shape = state.get("_shape", state.get("shape"))
    if shape is None or "data" not in state:
        raise ValueError("it holds a sparse matrix without shape or data")
    size = tuple(int(n) for n in shape)
    data = _array_of(state["data"])
    rows, columns = state["coords"] if "coords" in state else (state.get("row"), state.get("col"))
    if rows is not None and columns is not None:
        return sparse.coo_array((data, (_array_of(rows), _array_of(columns))), shape=size).toarray()
    if "indices" not in state or "indptr" not in state:
        raise ValueError("it holds a sparse matrix that is neither csr, csc nor coo")
    indices, pointers = _array_of(state["indices"]), _array_of(state["indptr"])
    # csr has a pointer a row, csc a pointer a column; a regressor (J,V) is never square
    kind = {size[0] + 1: sparse.csr_array, size[1] + 1: sparse.csc_array}.get(len(pointers))
    if kind is None:
        raise ValueError(f"it holds a sparse matrix of shape {size} with {len(pointers)} pointers")
    compressed = kind((data, indices, pointers), shape=size)
    compressed.check_format(full_check=True)  # a forged index would read beyond the array
    return compressed.toarray()
