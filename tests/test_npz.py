"""Every way in which an npz file can be wrong has its one line."""

import numpy as np
import pytest

from workbench.npz import read_npz


def test_arrays_come_back(tmp_path, rng):
    array = rng.normal(size=(3, 2))
    np.savez_compressed(tmp_path / "a.npz", array=array)
    assert np.array_equal(read_npz(tmp_path / "a.npz", "a thing")["array"], array)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a simulated sequence"):
        read_npz(tmp_path / "a.npz", "a simulated sequence")


@pytest.mark.parametrize("keep", [0, 10, 300, 4000])
def test_a_file_cut_anywhere_is_refused_in_one_line(tmp_path, rng, keep):
    np.savez_compressed(tmp_path / "a.npz", array=rng.normal(size=1000))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:keep])
    with pytest.raises(ValueError, match=r"cut\.npz is not readable as a thing") as failure:
        read_npz(tmp_path / "cut.npz", "a thing")
    assert "\n" not in str(failure.value)


def test_damaged_bytes_inside_are_noticed(tmp_path, rng):
    np.savez_compressed(tmp_path / "a.npz", array=rng.normal(size=1000))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[2000:2100] = bytes(100)
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match="not readable as a thing"):
        read_npz(tmp_path / "a.npz", "a thing")


def test_python_objects_are_never_unpickled(tmp_path):
    np.savez(tmp_path / "a.npz", array=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="not readable as a thing"):
        read_npz(tmp_path / "a.npz", "a thing")


def test_a_foreign_npz_says_what_it_lacks_and_holds(tmp_path):
    np.savez(tmp_path / "a.npz", other=np.zeros(2))
    with pytest.raises(ValueError, match=r"is not a thing: it lacks faces, vertices \(it holds other\)"):
        read_npz(tmp_path / "a.npz", "a thing", required=("vertices", "faces"))
