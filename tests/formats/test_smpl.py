"""SMPL-format files: what is written is read back, from npz and from pickles as they are published; code never runs."""

import builtins
import io
import os
import pickle
import sys
import types
import zipfile

import numpy as np
import pytest
from scipy import sparse

from workbench.formats.smpl import read_smpl

VERTICES, JOINTS, COMPONENTS = 7, 3, 4


@pytest.fixture
def arrays(rng):
    weights = rng.random((VERTICES, JOINTS))
    regressor = rng.random((JOINTS, VERTICES)) * (rng.random((JOINTS, VERTICES)) > 0.5)
    return {
        "v_template": rng.normal(size=(VERTICES, 3)),
        "shapedirs": rng.normal(size=(VERTICES, 3, COMPONENTS)),
        "posedirs": rng.normal(size=(VERTICES, 3, 9 * (JOINTS - 1))),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, 0, 1], [0, 1, 2]], dtype=np.uint32),
        "f": np.array([[0, 1, 2], [2, 3, 6]], dtype=np.uint32),
    }


def assert_same(read, arrays):
    np.testing.assert_allclose(read.template, arrays["v_template"], rtol=1e-6)
    np.testing.assert_allclose(read.shape_directions, arrays["shapedirs"], rtol=1e-6)
    np.testing.assert_allclose(read.pose_directions, arrays["posedirs"], rtol=1e-6)
    np.testing.assert_allclose(read.weights, arrays["weights"], rtol=1e-6)
    np.testing.assert_allclose(read.joint_regressor, arrays["J_regressor"], rtol=1e-6)
    np.testing.assert_array_equal(read.faces, arrays["f"])
    assert read.parents == (-1, 0, 1)


class FakeChumpy:
    """What chumpy's classes look like to pickle: a module, a name, and a dictionary of attributes."""

    def __init__(self, monkeypatch):
        self.ch = types.SimpleNamespace(Ch=type("Ch", (), {"__module__": "chumpy.ch"}))
        self.reordering = types.SimpleNamespace(Select=type("Select", (), {"__module__": "chumpy.reordering"}))
        self.modules = {
            "chumpy": types.ModuleType("chumpy"),
            "chumpy.ch": self.ch,
            "chumpy.reordering": self.reordering,
        }
        self.monkeypatch = monkeypatch

    def dump(self, content, protocol):
        with self.monkeypatch.context() as patch:
            for name, module in self.modules.items():
                patch.setitem(sys.modules, name, module)
            return pickle.dumps(content, protocol=protocol)

    def constant(self, array):
        expression = self.ch.Ch()
        expression.__dict__.update(x=array, _status="new", _dirty_vars={"x"})
        return expression

    def select(self, array, chosen, shape):
        expression = self.reordering.Select()
        expression.__dict__.update(a=self.constant(array), idxs=chosen, preferred_shape=shape)
        return expression


def test_npz_reads_back(tmp_path, arrays):
    np.savez(tmp_path / "body.npz", **arrays, extra=np.zeros(3))
    assert_same(read_smpl(tmp_path / "body.npz"), arrays)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_pickle_reads_back(tmp_path, arrays, protocol):
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(arrays | {"bs_type": "lrotmin"}, protocol=protocol))
    assert_same(read_smpl(tmp_path / "body.pkl"), arrays)


@pytest.mark.parametrize("matrix", [sparse.csc_matrix, sparse.csr_matrix, sparse.coo_matrix, sparse.csc_array])
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_pickle_with_chumpy_and_scipy_reads_back(tmp_path, arrays, monkeypatch, matrix, protocol):
    chumpy = FakeChumpy(monkeypatch)
    wide = np.concatenate([arrays["shapedirs"], np.ones((VERTICES, 3, 2))], axis=2)
    kept = np.arange(wide.size).reshape(wide.shape)[:, :, :COMPONENTS].ravel()
    content = arrays | {
        "v_template": chumpy.constant(arrays["v_template"]),
        "shapedirs": chumpy.select(wide, kept, (VERTICES, 3, COMPONENTS)),
        "posedirs": chumpy.constant(np.asfortranarray(arrays["posedirs"])),
        "J_regressor": matrix(arrays["J_regressor"]),
    }
    (tmp_path / "body.pkl").write_bytes(chumpy.dump(content, protocol))
    assert "chumpy" not in sys.modules
    assert_same(read_smpl(tmp_path / "body.pkl"), arrays)


class Calls:
    """Pickles to a call of `function` on `arguments`."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


HOSTILE = {
    "os.system": lambda trace: Calls(os.system, f"touch {trace}"),
    "eval": lambda trace: Calls(builtins.eval, f"open({str(trace)!r}, 'w')"),
    "getattr": lambda trace: Calls(builtins.getattr, np.ndarray, "tofile"),
    "numpy load": lambda trace: Calls(np.load, str(trace), None, True),
    "numpy fromfile": lambda trace: Calls(np.fromfile, "/etc/hostname"),
    "write": lambda trace: Calls(open, str(trace), "w"),
    "scipy io": lambda trace: Calls(__import__("scipy.io", fromlist=["loadmat"]).loadmat, str(trace)),
}


@pytest.mark.parametrize("attack", HOSTILE)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_pickle_that_would_run_code_is_refused(tmp_path, arrays, attack, protocol):
    trace = tmp_path / "trace"
    content = arrays | {"v_template": HOSTILE[attack](trace)}
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(content, protocol=protocol))
    with pytest.raises(ValueError, match=r"could run code; only arrays are read") as refused:
        read_smpl(tmp_path / "body.pkl")
    assert not trace.exists()
    assert "\n" not in str(refused.value)


def test_pickle_never_reaches_through_dotted_names(tmp_path):
    name = b"Ch.__init__.__globals__.exec"
    program = b"\x80\x04\x8c\x09chumpy.ch\x8c" + bytes([len(name)]) + name + b"\x93\x8c\x04pass\x85R."
    (tmp_path / "body.pkl").write_bytes(program)
    with pytest.raises(ValueError, match="expected a dictionary of arrays"):
        read_smpl(tmp_path / "body.pkl")


def test_forged_arrays_are_refused(tmp_path, arrays):
    """A structured dtype, an object array and a shape larger than the data: numpy's own unpickling never sees them."""
    forged = {
        "structured": (np.zeros(VERTICES, dtype=[("x", "f8"), ("y", "f8")]), "expected numbers"),
        "objects": (np.array([None] * 3, dtype=object), "expected numbers|array of objects"),
    }
    for name, (array, message) in forged.items():
        (tmp_path / f"{name}.pkl").write_bytes(pickle.dumps(arrays | {"v_template": array}))
        with pytest.raises(ValueError, match=message):
            read_smpl(tmp_path / f"{name}.pkl")
    stretched = pickle.dumps(arrays, protocol=2).replace(b"K\x07K\x03\x86", b"K\x7fK\x03\x86", 1)
    (tmp_path / "stretched.pkl").write_bytes(stretched)
    with pytest.raises(ValueError, match="cannot reshape"):
        read_smpl(tmp_path / "stretched.pkl")


def test_forged_sparse_index_is_refused(tmp_path, arrays):
    matrix = sparse.csc_matrix(arrays["J_regressor"])
    matrix.indices[0] = 10**6
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(arrays | {"J_regressor": matrix}))
    with pytest.raises(ValueError, match="not a readable SMPL pickle"):
        read_smpl(tmp_path / "body.pkl")


def test_unknown_chumpy_expression_is_told(tmp_path, arrays, monkeypatch):
    chumpy = FakeChumpy(monkeypatch)
    expression = chumpy.ch.Ch()
    expression.left = np.ones(3)
    (tmp_path / "body.pkl").write_bytes(chumpy.dump(arrays | {"v_template": expression}, 2))
    with pytest.raises(ValueError, match=r"chumpy expression of .*'left'.*save it as npz"):
        read_smpl(tmp_path / "body.pkl")


def test_truncated_files_are_refused_at_any_length(tmp_path, arrays):
    np.savez(tmp_path / "body.npz", **arrays)
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(arrays))
    for name, message in (
        ("body.npz", "not readable as an SMPL-format body"),
        ("body.pkl", "not a readable SMPL pickle"),
    ):
        whole = (tmp_path / name).read_bytes()
        for share in (0.0, 0.01, 0.3, 0.6, 0.99):
            (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(ValueError, match=message):
                read_smpl(tmp_path / name)


def test_foreign_npz_is_refused(tmp_path, arrays):
    np.savez(tmp_path / "motion.npz", poses=np.zeros((3, 156)))
    with pytest.raises(ValueError, match="lacks J_regressor, f, kintree_table"):
        read_smpl(tmp_path / "motion.npz")
    np.savez(tmp_path / "objects.npz", **arrays | {"v_template": np.array([{}], dtype=object)})
    with pytest.raises(ValueError, match="not readable as an SMPL-format body"):
        read_smpl(tmp_path / "objects.npz")
    with zipfile.ZipFile(tmp_path / "photos.npz", "w") as archive:
        archive.writestr("holiday.txt", "sun")
    with pytest.raises(ValueError, match="SMPL-format body"):
        read_smpl(tmp_path / "photos.npz")


def test_arrays_that_disagree_are_refused(tmp_path, arrays):
    bad = {
        "weights": (np.ones((VERTICES, JOINTS + 1)), r"weights has shape \(7, 4\), expected \(7, 3\)"),
        "posedirs": (np.ones((VERTICES, 3, 5)), "posedirs has 5 directions, expected 18 for 3 joints"),
        "f": (np.array([[0, 1, VERTICES]]), "faces index vertex 7, but the body has 7 vertices"),
        "kintree_table": (np.array([[2**32 - 1, 2, 0], [0, 1, 2]]), "each must come before its child"),
        "v_template": (np.full((VERTICES, 3), np.nan), "v_template holds NaN or infinity"),
        "shapedirs": (np.full((VERTICES, 3, 4), "a"), "shapedirs holds .*, expected numbers"),
    }
    for key, (value, message) in bad.items():
        np.savez(tmp_path / "bad.npz", **arrays | {key: value})
        with pytest.raises(ValueError, match=message):
            read_smpl(tmp_path / "bad.npz")


def test_wrong_path_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="no body file at"):
        read_smpl(tmp_path / "absent.npz")
    (tmp_path / "body.fbx").write_bytes(io.BytesIO().getvalue())
    with pytest.raises(ValueError, match=r"expected \.npz or \.pkl, got '\.fbx'"):
        read_smpl(tmp_path / "body.fbx")
