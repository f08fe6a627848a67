"""Reading npz files that may be anything: path -> arrays by name, or one clear ValueError."""

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np


def read_npz(path: str | Path, what: str, required: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """All arrays of an npz file; nothing is unpickled.

    `what` names in the error what the file should have been ("a simulated sequence").
    Errors: FileNotFoundError; ValueError for a truncated or foreign file, arrays of Python objects, missing keys.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}; expected {what} (.npz)")
    try:
        with np.load(path, allow_pickle=False) as file:
            if isinstance(file, np.ndarray):
                raise ValueError("it holds one bare array")
            arrays = {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"{path} is not readable as {what}: {reason}; it may be truncated or of another kind"
        ) from error
    missing = sorted(set(required) - set(arrays))
    if missing:
        raise ValueError(f"{path} is not {what}: it lacks {', '.join(missing)} (it holds {', '.join(sorted(arrays))})")
    return arrays
