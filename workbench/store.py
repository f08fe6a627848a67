"""Results on disk: what made them in -> a file named by it, whole, verified, made once.

A result is named by the hash of the configuration and of the code that made it.  It appears whole or not at all, one
process makes it while others wait, and a file that changed since is refused.
"""

import contextlib
import dataclasses
import enum
import hashlib
import importlib.util
import json
import logging
import math
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import platformdirs

log = logging.getLogger(__name__)


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a path beside `path` to write to; when the block ends well, it becomes `path` in one step.

    When the block raises, or the disk is full, `path` is what it was before and nothing is left behind.  The yielded
    name keeps the suffix, because numpy appends one that is missing.  The folder is made when it does not exist.

    Raises OSError when the disk refuses, ValueError when the block wrote nothing.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.partial-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        yield part
        if not part.exists():
            raise ValueError(f"nothing was written for {path}: write to the path that atomic_write yields")
        with part.open("rb+") as written:
            os.fsync(written.fileno())  # a full disk may only be noticed here
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """The rename itself must survive a power cut; Windows has no such call and needs none."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def cache_folder() -> Path:
    """WORKBENCH_CACHE when set, else the platform's cache folder."""
    chosen = os.environ.get("WORKBENCH_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("garment-workbench", appauthor=False))


def file_hash(path: str | Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def code_version(*modules: str) -> str:
    """Hash of the source text of the named modules: a result is made anew when the code that makes it changed."""
    digest = hashlib.sha256()
    for name in sorted(modules):
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None or not Path(spec.origin).is_file():
            raise ValueError(f"there is no module {name!r} with source text to hash")
        digest.update(name.encode() + b"\0" + Path(spec.origin).read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def describe(value: Any) -> Any:
    """A configuration as plain JSON that is the same in every process: dataclasses by name, arrays by their content."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: describe(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, enum.Enum):
        return value.name
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else repr(value)
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise ValueError(f"a mapping with keys {list(value)!r} cannot name a result: its keys must be strings")
        return {key: describe(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [describe(entry) for entry in value]
    if type(value).__module__.partition(".")[0] == "torch":  # tensors, without importing torch
        tensor: Any = value
        value = tensor.detach().cpu().numpy()
    if isinstance(value, np.generic):
        return describe(value.item())
    if isinstance(value, np.ndarray) and value.dtype != object:
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"dtype": str(value.dtype), "shape": list(value.shape), "sha256": content}
    raise ValueError(
        f"a {type(value).__name__} cannot name a result: use dataclasses, numbers, strings, paths, tuples and arrays"
    )


def config_hash(config: Any) -> str:
    """Sixteen hexadecimal digits, the same for equal configurations in any process and on any machine."""
    text = json.dumps(describe(config), sort_keys=True, ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclasses.dataclass(frozen=True)
class Result:
    """One stored result: where it lies and what made it."""

    path: Path
    kind: str
    made_by: Any  # `describe` of the configuration
    code: str
    sha256: str


class Store:
    """Results in one folder, each beside a small JSON file that says what made it and what its bytes hash to."""

    def __init__(self, folder: str | Path | None = None):
        self.folder = Path(folder) if folder is not None else cache_folder()

    def path(self, kind: str, config: Any, code: str = "", suffix: str = ".npz") -> Path:
        """Where the result of this configuration and code lies or will lie."""
        return self.folder / f"{kind}-{config_hash([describe(config), code])}{suffix}"

    def find(self, kind: str, config: Any, code: str = "", suffix: str = ".npz") -> Result | None:
        """The verified result, or None when it has not been made.

        Raises ValueError when the file changed since it was made.
        """
        path = self.path(kind, config, code, suffix)
        record = _record_path(path)
        if not (path.exists() and record.exists()):
            return None  # without its record a file was never finished
        try:
            entry = json.loads(record.read_text(encoding="utf-8"))
            expected = entry["sha256"]
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{record} is damaged ({error}): delete it, and the result is made again") from error
        got = file_hash(path)
        if got != expected:
            raise ValueError(
                f"{path} is damaged: its SHA-256 is {got[:12]}..., but {expected[:12]}... was written: "
                f"delete it, and the result is made again"
            )
        return Result(path, kind, entry["made_by"], code, got)

    def make(
        self,
        kind: str,
        config: Any,
        write: Callable[[Path], object],
        code: str = "",
        suffix: str = ".npz",
        patience: float = -1.0,
    ) -> Result:
        """The result, made by `write(path)` if it is not there; one process makes it, others wait for that one.

        `patience` is how many seconds to wait for another process (-1: as long as it takes).
        Raises TimeoutError when that is over, ValueError as `find`.
        """
        path = self.path(kind, config, code, suffix)
        with locked(path, patience):
            found = self.find(kind, config, code, suffix)
            if found is not None:
                return found
            log.info("making %s", path.name)
            with atomic_write(path) as part:
                write(part)
            entry = {"kind": kind, "made_by": describe(config), "code": code, "sha256": file_hash(path)}
            _write_json(_record_path(path), entry)
            return Result(path, kind, entry["made_by"], code, entry["sha256"])


@contextlib.contextmanager
def locked(path: str | Path, patience: float = -1.0) -> Iterator[None]:
    """Hold the lock of `path`.  The system releases it when its holder dies, so a lock is never stale.

    Raises TimeoutError after `patience` seconds (-1: never).
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(path.with_name(f".{path.name}.lock"))
    try:
        lock.acquire(timeout=patience)
    except filelock.Timeout as error:
        raise TimeoutError(
            f"another process has been working on {path} for {patience:g} s: wait for it, or end it"
        ) from error
    try:
        yield
    finally:
        lock.release()


def add_to_manifest(
    manifest: str | Path,
    file: str | Path,
    *,
    command: str,
    config: Any,
    licence: str,
    seed: int | None = None,
    code: str = "",
    scores: Mapping[str, float] | None = None,
) -> None:
    """Record in `manifest` (JSON, file -> how it was made) what `file`, which lies below it, was made by.

    Safe to call from several processes: each entry is added under a lock and the manifest is replaced whole.
    """
    manifest, file = Path(manifest), Path(file)
    name = file.resolve().relative_to(manifest.resolve().parent).as_posix()
    entry = {
        "command": command,
        "config": describe(config),
        "seed": seed,
        "code": code,
        "scores": dict(scores or {}),
        "licence": licence,
        "sha256": file_hash(file),
        "bytes": file.stat().st_size,
    }
    with locked(manifest):
        entries = json.loads(manifest.read_text(encoding="utf-8")) if manifest.exists() else {}
        entries[name] = entry
        _write_json(manifest, dict(sorted(entries.items())))


def check_manifest(manifest: str | Path) -> list[str]:
    """Faults of what ships, one line each: files that are missing or are not the ones recorded."""
    manifest = Path(manifest)
    faults = []
    for name, entry in json.loads(manifest.read_text(encoding="utf-8")).items():
        path = manifest.parent / name
        if not path.is_file():
            faults.append(f"{name} is missing: regenerate it with {entry['command']}")
        elif file_hash(path) != entry["sha256"]:
            faults.append(f"{name} is not the file that was recorded: regenerate it with {entry['command']}")
    return faults


def _record_path(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _write_json(path: Path, entry: Any) -> None:
    with atomic_write(path) as part:
        part.write_text(json.dumps(entry, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
