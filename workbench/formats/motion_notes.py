"""What motion files do not say, or say wrongly, in a note beside them: rate and joint names.  file -> MotionNotes.

CLIP.bvh.notes.json is about one clip, motions.notes.json about all clips of its folder; what the first says goes first:
    {"fps": 60, "joints": {"LeftLeg": "KneeL"}}
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

OF_FOLDER = "motions.notes.json"
KEYS = ("fps", "joints")
FASTEST = 1e5  # frames a second


@dataclass(frozen=True)
class MotionNotes:
    """fps: what the file's frame rate really is; joints: role -> joint name, for rigs of no known convention."""

    fps: float | None = None
    joints: Mapping[str, str] = field(default_factory=dict)


def notes_beside(path: Path) -> MotionNotes:
    """The notes about a motion file, empty where there are none.  Raises ValueError for one that cannot be used."""
    known: dict[str, Any] = {}
    for note in (path.with_name(OF_FOLDER), path.with_name(path.name + ".notes.json")):
        if note.is_file():
            known |= _read(note)
    return MotionNotes(**known)


def _read(note: Path) -> dict[str, Any]:
    try:
        told = json.loads(note.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise ValueError(f"{note} is not readable as JSON: {error}") from error
    if not isinstance(told, dict) or set(told) - set(KEYS):
        raise ValueError(f'{note} must be {{"fps": number, "joints": {{role: joint}}}}, or one of the two')
    found, joints = {}, told.get("joints", {})
    if told.get("fps") is not None:
        found["fps"] = _rate(note, told["fps"])
    if not isinstance(joints, dict) or not all(isinstance(name, str) for name in joints.values()):
        raise ValueError(f"{note}: joints must give a joint's name for each role, got {joints!r}")
    return found | ({"joints": joints} if joints else {})


def _rate(note: Path, fps: Any) -> float:
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < FASTEST:
        raise ValueError(f"{note}: fps must be a number above 0, got {fps!r}")
    return float(fps)
