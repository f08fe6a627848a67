"""Results on disk: whole or absent, named by what made them, made once, refused when they changed."""

import dataclasses
import enum
import errno
import json
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from workbench import store
from workbench.store import Store, atomic_write, config_hash


class Skinning(enum.Enum):
    LINEAR = 1
    DUAL = 2


@dataclasses.dataclass(frozen=True)
class Inner:
    width: int = 3


@dataclasses.dataclass(frozen=True)
class Config:
    rate: float = 0.1
    name: str = "a"
    inner: Inner = Inner()
    path: Path = Path("x/y")
    betas: tuple[float, ...] = (0.0, 1.0)
    skinning: Skinning = Skinning.LINEAR
    mask: np.ndarray | None = None


def files_in(folder):
    return sorted(path.name for path in folder.iterdir())


# --- atomic_write


def test_written_file_appears_whole_with_its_suffix(tmp_path):
    target = tmp_path / "new" / "folder" / "numbers.npz"
    with atomic_write(target) as part:
        assert part.parent == target.parent
        assert part.suffix == ".npz"
        np.savez(part, a=np.arange(3))
        assert not target.exists()
    np.testing.assert_array_equal(np.load(target)["a"], np.arange(3))
    assert files_in(target.parent) == ["numbers.npz"]


@pytest.mark.parametrize(
    "error", [ValueError("no"), OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "old.txt"
    target.write_text("old")
    with pytest.raises(type(error)), atomic_write(target) as part:
        part.write_text("half")
        raise error
    assert target.read_text() == "old"
    assert files_in(tmp_path) == ["old.txt"]


def test_disk_that_is_full_only_at_the_end_leaves_the_old_file(tmp_path, monkeypatch):
    target = tmp_path / "old.txt"
    target.write_text("old")

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"), atomic_write(target) as part:
        part.write_text("new")
    assert target.read_text() == "old"
    assert files_in(tmp_path) == ["old.txt"]


@pytest.mark.skipif(os.name != "posix", reason="limits a process's file size the POSIX way")
def test_really_full_leaves_nothing(tmp_path):
    """A process that may write 64 kB writes 1 MB."""
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (65536, 65536));"
        "from workbench.store import atomic_write\n"
        "with atomic_write(sys.argv[1]) as part: part.write_bytes(bytes(10**6))"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(tmp_path / "big")], capture_output=True, text=True)
    assert ended.returncode != 0
    assert "File too large" in ended.stderr
    assert files_in(tmp_path) == []


def test_writing_elsewhere_is_told(tmp_path):
    with pytest.raises(ValueError, match="nothing was written for .*write to the path that atomic_write yields"):
        with atomic_write(tmp_path / "a.txt"):
            pass


# --- names


def test_equal_configurations_have_one_name_and_any_change_another():
    changed = [
        Config(rate=0.2),
        Config(name="b"),
        Config(inner=Inner(4)),
        Config(path=Path("x/z")),
        Config(betas=(0.0,)),
        Config(skinning=Skinning.DUAL),
        Config(mask=np.zeros(3)),
        Config(mask=np.zeros(3, np.float32)),
        Config(mask=np.zeros((3, 1))),
    ]
    names = {config_hash(config) for config in [Config(), *changed]}
    assert len(names) == len(changed) + 1
    assert config_hash(Config()) == config_hash(Config(betas=(0.0, 1.0)))


def test_array_and_tensor_are_the_same_content():
    assert config_hash({"a": np.arange(3.0)}) == config_hash({"a": torch.arange(3.0, dtype=torch.float64)})


def test_name_is_the_same_in_another_process():
    code = "from workbench.store import config_hash; print(config_hash({'b': 1.5, 'a': [None, True, 'ß']}))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.strip() == config_hash({"a": [None, True, "ß"], "b": 1.5})


@given(st.dictionaries(st.text(), st.floats() | st.integers() | st.text() | st.none() | st.booleans()))
def test_any_plain_configuration_has_a_name(config):
    assert len(config_hash(config)) == 16
    assert config_hash(config) == config_hash(dict(reversed(config.items())))


def test_what_cannot_name_a_result_is_told():
    with pytest.raises(ValueError, match="a function cannot name a result"):
        config_hash({"make": lambda: 0})
    with pytest.raises(ValueError, match="its keys must be strings"):
        config_hash({1: 2})


def test_code_version_follows_the_source():
    assert store.code_version("workbench.store") != store.code_version("workbench.cli")
    assert store.code_version("workbench.store", "workbench.cli") == store.code_version(
        "workbench.cli", "workbench.store"
    )
    with pytest.raises(ValueError, match="no module 'workbench_nothing'"):
        store.code_version("workbench_nothing")


# --- store


def test_result_is_made_once_and_found_again(tmp_path):
    shelf, made = Store(tmp_path), []

    def write(path):
        made.append(path)
        np.savez(path, a=np.ones(2))

    first = shelf.make("fields", Config(), write, code="1")
    again = shelf.make("fields", Config(), write, code="1")
    assert first == again
    assert len(made) == 1
    assert first.path == shelf.path("fields", Config(), "1")
    assert shelf.find("fields", Config(), code="2") is None
    assert shelf.find("fields", Config(rate=9.0), code="1") is None


def test_changed_result_is_refused(tmp_path):
    shelf = Store(tmp_path)
    result = shelf.make("fields", Config(), lambda path: path.write_bytes(b"good"))
    result.path.write_bytes(b"evil")
    with pytest.raises(ValueError, match=r"is damaged: its SHA-256 is .* delete it, and the result is made again"):
        shelf.find("fields", Config())
    result.path.unlink()
    assert shelf.make("fields", Config(), lambda path: path.write_bytes(b"good")) == result


def test_damaged_record_is_refused(tmp_path):
    shelf = Store(tmp_path)
    result = shelf.make("fields", Config(), lambda path: path.write_bytes(b"good"))
    result.path.with_name(result.path.name + ".json").write_text('{"sha')
    with pytest.raises(ValueError, match=r"\.json is damaged .* delete it"):
        shelf.find("fields", Config())


def test_interrupted_result_is_made_again(tmp_path):
    shelf = Store(tmp_path)
    with pytest.raises(RuntimeError):
        shelf.make("fields", Config(), fail)
    assert shelf.find("fields", Config()) is None
    shelf.path("fields", Config()).write_bytes(b"file without record: its process died in between")
    assert shelf.find("fields", Config()) is None
    shelf.make("fields", Config(), lambda path: path.write_bytes(b"good"))
    assert shelf.path("fields", Config()).read_bytes() == b"good"


def fail(path):
    path.write_bytes(b"half")
    raise RuntimeError("the simulation diverged")


def make_slowly(folder, trace):
    def write(path):
        with Path(trace).open("a") as file:
            file.write("made\n")
        time.sleep(0.3)
        path.write_bytes(b"good")

    Store(folder).make("fields", {"a": 1}, write)


def test_many_processes_make_it_once(tmp_path):
    context = multiprocessing.get_context("fork" if os.name == "posix" else "spawn")
    workers = [context.Process(target=make_slowly, args=(tmp_path, tmp_path / "trace")) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(30)
        assert worker.exitcode == 0
    assert (tmp_path / "trace").read_text() == "made\n"


def test_waiting_ends_with_a_clear_line_and_a_dead_holder_locks_nothing(tmp_path):
    code = (
        "import sys, time\nfrom workbench.store import locked\n"
        "with locked(sys.argv[1]): print('held', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "a")], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(TimeoutError, match=r"another process has been working on .* for 0.1 s"):
        with store.locked(tmp_path / "a", patience=0.1):
            pass
    holder.kill()
    holder.wait()
    with store.locked(tmp_path / "a", patience=5.0):
        pass


def test_cache_folder_is_chosen_by_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("WORKBENCH_CACHE", str(tmp_path))
    assert Store().folder == tmp_path
    monkeypatch.delenv("WORKBENCH_CACHE")
    assert "garment-workbench" in str(Store().folder)


# --- manifest


def test_manifest_tells_what_made_a_file_and_notices_changes(tmp_path):
    manifest = tmp_path / "manifest.json"
    for name in ("b.npz", "a.npz"):
        (tmp_path / "body").mkdir(exist_ok=True)
        (tmp_path / "body" / name).write_bytes(name.encode())
        store.add_to_manifest(
            manifest,
            tmp_path / "body" / name,
            command="python -m assets_gen body",
            config=Config(),
            seed=3,
            licence="CC0",
            scores={"error": 1.2},
        )
    entries = json.loads(manifest.read_text())
    assert list(entries) == ["body/a.npz", "body/b.npz"]
    assert entries["body/a.npz"]["config"]["inner"] == {"type": "Inner", "width": 3}
    assert entries["body/a.npz"]["scores"] == {"error": 1.2}
    assert store.check_manifest(manifest) == []
    (tmp_path / "body" / "a.npz").write_bytes(b"other")
    (tmp_path / "body" / "b.npz").unlink()
    first, second = store.check_manifest(manifest)
    assert first == "body/a.npz is not the file that was recorded: regenerate it with python -m assets_gen body"
    assert second == "body/b.npz is missing: regenerate it with python -m assets_gen body"
