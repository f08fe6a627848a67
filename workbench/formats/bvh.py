"""BVH (Biovision hierarchy): text file <-> Motion on the file's own skeleton, in the file's own units and axes."""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.skeleton import Skeleton
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_euler
from workbench.motion import Motion
from workbench.retargeting import Y_UP_FROM_Z_UP, reframed
from workbench.store import atomic_write

log = logging.getLogger(__name__)

END_SITE = " End"
"""An End Site is read as a joint that never turns, called like its parent with this behind it."""

_POSITIONS = ("Xposition", "Yposition", "Zposition")
_ROTATIONS = ("Xrotation", "Yrotation", "Zrotation")


@dataclass
class _Joint:
    name: str
    parent: int
    line: int
    offset: list[float] | None = None
    channels: list[str] = field(default_factory=list)
    children: int = 0


def read_bvh(path: str | Path, *, fps: float | None = None) -> Motion:
    """The motion as the file has it: its joints (End Sites as joints named `END_SITE`), units and axes.

    Any channel order, any set of channels a joint.  A joint's positions other than the root's cannot be kept in a
    Motion; they are dropped, with a warning when they move.  fps overrides the header, which some files have wrong.
    Raises FileNotFoundError, or ValueError naming file and line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no motion file at {path}")
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a number above 0, but got {fps}")
    lines = path.read_bytes().decode("utf-8-sig", errors="replace").splitlines()
    hierarchy_end = _check_outline(path, lines)
    joints = _read_hierarchy(path, lines, hierarchy_end)
    values, file_fps = _read_frames(path, lines, hierarchy_end, joints, fps)
    return _to_motion(path, joints, values, file_fps if fps is None else fps)


def write_bvh(
    path: str | Path,
    motion: Motion,
    *,
    order: str = "zxy",
    up: Literal["y", "z"] = "y",
    units_per_metre: float = 100.0,
) -> None:
    """Write a motion in metres with z up as BVH: y up, facing +z, in centimetres, as most programs expect.

    up="z" and units_per_metre=1 write the motion's own numbers.  order names the rotation channels from left to right.
    """
    for name in motion.skeleton.names:
        if not name.strip() or any(letter in name for letter in "{}\n\r"):
            raise ValueError(f"a joint of a BVH file needs a name without braces and line breaks, but got {name!r}")
    turn = Y_UP_FROM_Z_UP if up == "y" else torch.eye(3, dtype=torch.float64)
    motion = reframed(motion, turn, scale=units_per_metre)
    channels = " ".join(f"{letter.upper()}rotation" for letter in order)
    lines = ["HIERARCHY", *_hierarchy_lines(motion.skeleton, channels)]
    lines += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1 / motion.fps:.10g}"]
    turning = [j for j in _depth_first(motion.skeleton, 0) if not _is_end_site(motion.skeleton, j)]
    angles = torch.rad2deg(matrix_to_euler(motion.rotations[:, turning].double(), order)).flatten(1)
    root = motion.skeleton.rest_joints[0].double() + motion.translation.double()
    for row in torch.cat([root, angles], dim=1).tolist():
        lines.append(" ".join(f"{value:.8g}" for value in row))
    with atomic_write(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _is_end_site(skeleton: Skeleton, joint: int) -> bool:
    parent = skeleton.parents[joint]
    return parent >= 0 and skeleton.names[joint] == skeleton.names[parent] + END_SITE and not skeleton.children(joint)


def _depth_first(skeleton: Skeleton, joint: int) -> Iterator[int]:
    yield joint
    for child in skeleton.children(joint):
        yield from _depth_first(skeleton, child)


def _hierarchy_lines(skeleton: Skeleton, channels: str, joint: int = 0, depth: int = 0) -> Iterator[str]:
    indent, offset = "\t" * depth, skeleton.offsets if depth else skeleton.rest_joints
    root, end = depth == 0, _is_end_site(skeleton, joint)
    yield indent + ("End Site" if end else f"{'ROOT' if root else 'JOINT'} {skeleton.names[joint]}")
    yield indent + "{"
    yield indent + "\tOFFSET " + " ".join(f"{value:.8g}" for value in offset[joint].tolist())
    if not end:
        yield indent + (f"\tCHANNELS 6 {' '.join(_POSITIONS)} {channels}" if root else f"\tCHANNELS 3 {channels}")
        children = skeleton.children(joint)
        for child in children:
            yield from _hierarchy_lines(skeleton, channels, child, depth + 1)
        if not children:  # the format asks for an End Site below every last joint
            yield from (f"{indent}\t{line}" for line in ("End Site", "{", "\tOFFSET 0 0 0", "}"))
    yield indent + "}"


def _check_outline(path: Path, lines: list[str]) -> int:
    """Index of the MOTION line."""
    words = (line.split() for line in lines)
    first = next((line for line in words if line), [])
    if not first or first[0].upper() != "HIERARCHY":
        raise ValueError(
            f"{path}, line 1: a BVH file starts with HIERARCHY, but this one does not; is it another format?"
        )
    for number, line in enumerate(lines):
        if line.strip().upper() == "MOTION":
            return number
    raise ValueError(f"{path}, line {len(lines)}: the file ends without a MOTION section; it is truncated")


def _numbers(path: Path, line: int, words: list[str], what: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        bad = next(word for word in words if not _is_number(word))
        raise ValueError(f"{path}, line {line}: {what} must be numbers, but got {bad[:40]!r}") from None
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"{path}, line {line}: {what} must be finite, but hold NaN or infinity")
    return values


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_hierarchy(path: Path, lines: list[str], end: int) -> list[_Joint]:
    joints: list[_Joint] = []
    open_blocks: list[int] = []  # joints whose block is open
    declared: int | None = None  # the joint whose block has yet to open
    for number, line in enumerate(lines[:end], start=1):
        words = line.replace("{", " { ").replace("}", " } ").split()
        while words:
            word = words.pop(0)
            keyword = word.upper()
            if declared is not None and word != "{":
                raise ValueError(
                    f"{path}, line {number}: expected '{{' after joint {joints[declared].name!r}, got {word!r}"
                )
            if keyword == "HIERARCHY":
                continue
            if keyword in ("ROOT", "JOINT", "END"):
                title = []
                while words and words[0] != "{":
                    title.append(words.pop(0))
                parent = open_blocks[-1] if open_blocks else -1
                if (keyword == "ROOT") != (parent == -1) or (keyword == "ROOT" and joints):
                    raise ValueError(
                        f"{path}, line {number}: a BVH file has one ROOT and all else inside it; got {word!r} here"
                    )
                name = joints[parent].name + END_SITE if keyword == "END" else " ".join(title)
                if not name:
                    raise ValueError(f"{path}, line {number}: {word} needs a name")
                if any(joint.name == name for joint in joints):
                    raise ValueError(f"{path}, line {number}: two joints are called {name!r}")
                if parent >= 0:
                    joints[parent].children += 1
                joints.append(_Joint(name, parent, number))
                declared = len(joints) - 1
            elif word == "{" and declared is not None:
                open_blocks.append(declared)
                declared = None
            elif word == "}" and open_blocks:
                joint = joints[open_blocks.pop()]
                if joint.offset is None:
                    raise ValueError(f"{path}, line {joint.line}: joint {joint.name!r} has no OFFSET")
            elif keyword == "OFFSET" and open_blocks:
                offset = _numbers(path, number, words[:3], "an OFFSET")
                if len(offset) != 3:
                    raise ValueError(f"{path}, line {number}: OFFSET needs 3 numbers, but has {len(offset)}")
                joints[open_blocks[-1]].offset = offset
                del words[:3]
            elif keyword == "CHANNELS" and open_blocks:
                joints[open_blocks[-1]].channels = _channels(path, number, words)
            else:
                raise ValueError(f"{path}, line {number}: {word[:40]!r} is not expected in the HIERARCHY of a BVH file")
    if open_blocks or declared is not None:
        joint = joints[declared if declared is not None else open_blocks[-1]]
        raise ValueError(
            f"{path}, line {end}: the block of joint {joint.name!r} is never closed; the file is truncated"
        )
    if not joints:
        raise ValueError(f"{path}, line {end}: the HIERARCHY holds no joint")
    return joints


def _channels(path: Path, number: int, words: list[str]) -> list[str]:
    """Take `CHANNELS n name ...` off the front of words."""
    count = int(words[0]) if words and words[0].isdigit() else -1
    names = {channel.lower(): channel for channel in (*_POSITIONS, *_ROTATIONS)}
    found = [names.get(word.lower(), "") for word in words[1 : 1 + max(count, 0)]]
    if count < 0 or len(found) != count or "" in found or len(set(found)) != count:
        raise ValueError(
            f"{path}, line {number}: CHANNELS needs a count and as many different names out of "
            f"{', '.join((*_POSITIONS, *_ROTATIONS))}, but got {' '.join(words)[:120]!r}"
        )
    del words[: 1 + count]
    return found


def _read_frames(
    path: Path, lines: list[str], start: int, joints: list[_Joint], fps: float | None
) -> tuple[np.ndarray, float]:
    """Channel values (T, C) and the header's rate."""
    content = [(number, line.split()) for number, line in enumerate(lines[start + 1 :], start + 2) if line.strip()]

    def header(position: int, label: str) -> tuple[int, str]:
        if position >= len(content):
            raise ValueError(f"{path}, line {len(lines)}: the file ends before '{label}'; it is truncated")
        number, words = content[position]
        text = " ".join(words)
        if not text.lower().startswith(label.lower()):
            raise ValueError(f"{path}, line {number}: expected '{label}', but got {text[:40]!r}")
        return number, text[len(label) :].strip().removeprefix(":").strip()

    number, text = header(0, "Frames")
    frames = int(text) if text.isdigit() else -1
    if frames < 1:
        raise ValueError(
            f"{path}, line {number}: a motion needs at least one frame, but the file says Frames: {text[:40]!r}"
        )
    number, text = header(1, "Frame Time")
    frame_time = float(text) if _is_number(text) else math.nan
    if fps is None and not (math.isfinite(frame_time) and frame_time > 0):
        raise ValueError(
            f"{path}, line {number}: Frame Time must be a number of seconds above 0, but is {text[:40]!r}; "
            f"pass fps=... if you know it"
        )
    width = sum(len(joint.channels) for joint in joints)
    rows = content[2:]
    for number, words in rows[:frames]:
        if len(words) != width:
            hint = "; the file is truncated" if len(words) < width and number == rows[-1][0] else ""
            raise ValueError(
                f"{path}, line {number}: a frame has one value for each of the {width} channels, "
                f"but this has {len(words)}{hint}"
            )
    if len(rows) != frames:
        hint = "; it is truncated" if len(rows) < frames else ""
        last = rows[-1][0] if rows else number
        raise ValueError(
            f"{path}, line {last}: the file says Frames: {frames}, but has {len(rows)} lines of values{hint}"
        )
    values = np.array([_numbers(path, number, words, "channel values") for number, words in rows])
    rate = 1 / frame_time if frame_time > 0 else math.nan
    return values.reshape(frames, width), _round_rate(rate)


def _round_rate(rate: float) -> float:
    """120.0005, from a frame time printed with five digits, means 120."""
    whole = round(rate) if math.isfinite(rate) else 0
    return float(whole) if whole and abs(rate - whole) < 1e-4 * whole else rate


def _to_motion(path: Path, joints: list[_Joint], values: np.ndarray, fps: float) -> Motion:
    frames = len(values)
    offsets = torch.tensor([joint.offset for joint in joints], dtype=torch.float64)
    rotations = torch.eye(3, dtype=torch.float64).repeat(frames, len(joints), 1, 1)
    places = offsets.repeat(frames, 1, 1)  # of each joint relative to its parent
    column = 0
    for j, joint in enumerate(joints):
        here = torch.from_numpy(values[:, column : column + len(joint.channels)])
        column += len(joint.channels)
        rotations[:, j] = _joint_rotation(here, joint.channels)
        for channel in joint.channels:
            if channel in _POSITIONS:  # stands instead of that coordinate of the OFFSET
                places[:, j, _POSITIONS.index(channel)] = here[:, joint.channels.index(channel)]
    size = offsets[1:].norm(dim=-1).max() if len(joints) > 1 else 0.0
    moving = ((places - offsets).abs().amax((0, 2)) > 1e-3 * size).tolist()
    root = 0
    while joints[root].children == 1 and root + 1 < len(joints) and moving[root + 1]:
        # A reference joint above the one that travels: the two are one root.
        places[:, root + 1] = places[:, root] + (rotations[:, root] @ places[:, root + 1, :, None])[..., 0]
        rotations[:, root + 1] = rotations[:, root] @ rotations[:, root + 1]
        root += 1
    kept = joints[root:]
    drifting = [joint.name for joint, moves in zip(kept[1:], moving[root + 1 :]) if moves]
    if drifting:
        log.warning(
            "%s: the positions of %d joints differ from their OFFSETs (%s); only the root's are kept",
            path, len(drifting), ", ".join(drifting[:5]),
        )  # fmt: skip
    rest = offsets[root:].clone()
    parents = tuple(max(joint.parent - root, -1) for joint in kept)
    for j, parent in enumerate(parents[1:], 1):
        rest[j] += rest[parent]
    skeleton = Skeleton(tuple(joint.name for joint in kept), parents, rest.float())
    translation = places[:, root] - rest[0]
    return Motion(rotations[:, root:].float(), translation.float(), fps, skeleton, name=path.stem)


def _joint_rotation(values: Float[Tensor, "T C"], channels: list[str]) -> Float[Tensor, "T 3 3"]:
    """The product of the axis rotations in the order of the channels; degrees."""
    R = torch.eye(3, dtype=values.dtype).repeat(len(values), 1, 1)
    for column, channel in enumerate(channels):
        if channel in _ROTATIONS:
            axis = torch.eye(3, dtype=values.dtype)[_ROTATIONS.index(channel)]
            R = R @ axis_angle_to_matrix(torch.deg2rad(values[:, column, None]) * axis)
    return R
