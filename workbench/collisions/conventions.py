"""Units and axes of meshes that people bring: moving meshes -> metres, z up; or a line that proposes how."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from workbench.formats.mesh_sequence import MeshSequence
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import boundary_loops, enclosed_volume, inspect_topology
from workbench.geometry.winding import check_closed

Unit = Literal["m", "cm", "mm"]
Up = Literal["z", "y", "x", "-z", "-y", "-x"]
METRES: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# Proper rotations that bring each axis up: columns of ours in terms of theirs.
UPRIGHT: dict[Up, Float[ndarray, "3 3"]] = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "-z": np.diag([1.0, -1, -1]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-x": np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]),
}
SIZES = (0.4, 3.0)  # metres: the longest side of a body's box, from a child to a tall adult with raised arms
NEAR = 0.15  # of the body's longest side: half of a garment's vertices are nearer than this, whatever it is
SAMPLES = 500
FLAT = 0.6  # a standing body's depth over its height, at most
WIDE = 0.85  # a standing body's height over its width with level arms, at least
EXTENTS = (0.05, 1.5)  # a garment's longest side over the body's, from a glove to a train


@dataclass(frozen=True)
class Convention:
    """How a file's numbers are meant; None: metres and z up are assumed, and doubted where they look wrong."""

    unit: Unit | None = None
    up: Up | None = None

    @property
    def told(self) -> bool:
        """Someone said so, and is believed."""
        return self.unit is not None or self.up is not None


def converted(sequence: MeshSequence, convention: Convention) -> MeshSequence:
    """The same in metres, z up."""
    if convention.unit in (None, "m") and convention.up in (None, "z"):
        return sequence
    turn = METRES[convention.unit or "m"] * UPRIGHT[convention.up or "z"].T
    return replace(sequence, vertices=(sequence.vertices @ turn).astype(np.float32))


def check_size(body: MeshSequence, convention: Convention) -> None:
    """ValueError where a body's size says that its unit is another one, with the flags that convert."""
    if convention.unit is not None:
        return
    size = float(np.ptp(body.vertices[0], axis=0).max())
    if SIZES[0] <= size <= SIZES[1]:
        return
    for unit, factor in METRES.items():
        if SIZES[0] <= size * factor <= SIZES[1]:
            raise ValueError(
                f"the body is {size:,.0f} units long, but metres are expected: it looks like {unit}; "
                f"add --body-unit {unit} (and --garment-unit {unit}, if the garment is in {unit}, too)"
            )
    raise ValueError(
        f"the body is {size:.3g} units long, which is no person in m, cm or mm; scale it, or add --body-unit m to take "
        "it as it is"
    )


def check_together(body: MeshSequence, garment: MeshSequence, convention: Convention) -> None:
    """ValueError where the garment is not on the body in the first frame, with the flags that put it there if any do.

    `convention` is what was said of the garment; then it is believed.
    """
    if convention.told:
        return
    surface = body.vertices[0]
    size = float(np.ptp(surface, axis=0).max())
    closest = ClosestPoint(surface, body.faces)
    extent = float(np.ptp(garment.vertices[0], axis=0).max()) / size
    picked = garment.vertices[0][:: max(1, garment.vertices.shape[1] // SAMPLES)].astype(np.float64)

    def distance(unit: Unit, up: Up) -> float:
        """Of the middle vertex from the body, over the body's size; infinite where the garment's size is absurd."""
        if not EXTENTS[0] <= METRES[unit] * extent <= EXTENTS[1]:
            return float("inf")
        points = (METRES[unit] * picked @ UPRIGHT[up].T).astype(np.float32)
        return float(np.median(closest.query(points).distance)) / size

    if distance("m", "z") <= NEAR:
        return
    candidates = {(unit, up): distance(unit, up) for unit, up in product(METRES, UPRIGHT)}
    unit, up = min(candidates, key=lambda choice: candidates[choice])
    apart = float(np.median(closest.query(picked.astype(np.float32)).distance))
    away = f"in frame 0 half of the garment is more than {apart:.3g} m away from the body, and it is {extent:.3g} of "
    away += "its size"
    if candidates[unit, up] <= NEAR:
        flags = [f"--garment-unit {unit}"] * (unit != "m") + [f"--garment-up {up}"] * (up != "z")
        looks = " and ".join([f"to be in {unit}"] * (unit != "m") + [f"to have {up} up"] * (up != "z"))
        raise ValueError(f"{away}: it looks {looks}, the body does not; add {' '.join(flags)}")
    raise ValueError(
        f"{away}, and no unit (m, cm, mm) or up axis puts it on: check that both are of one scene, or add "
        "--garment-unit m to take it as it is"
    )


def doubtful_up(body: MeshSequence) -> Up | None:
    """The axis that looks up where z does not: a standing body is much higher than deep.  Lying bodies look so, too."""
    x, y, z = np.ptp(body.vertices[0], axis=0)
    if z >= FLAT * max(x, y):
        return None
    return "y" if y >= WIDE * x else "x"


def closed_outwards(body: MeshSequence, *, fill_holes: bool, flip: bool) -> MeshSequence:
    """The body, closed and with its normals outwards; mended where that was asked for.

    Errors: ValueError for an open, unevenly oriented or inside-out body, with the flag that mends it where one does.
    """
    faces = torch.from_numpy(body.faces)
    topology = inspect_topology(faces, body.vertices.shape[1])
    border = topology.boundary_edges
    if len(border) and not topology.oriented:
        check_closed(body.faces)
    if len(border):
        loops = boundary_loops(faces)
        if not fill_holes:
            raise ValueError(
                f"the body is open: {len(loops)} holes, the largest of {len(loops[0])} edges, so nothing is inside it; "
                "close it, or add --fill-holes to close each with a fan"
            )
        body = _filled(body, [loop.numpy() for loop in loops])
    check_closed(body.faces)
    return _outwards(body, flip)


def _filled(body: MeshSequence, loops: list[ndarray]) -> MeshSequence:
    """Each hole closed by a fan to its middle, a new vertex that moves with its rim."""
    count = body.vertices.shape[1]
    middles = np.stack([body.vertices[:, loop].mean(1) for loop in loops], axis=1)
    fans = [np.stack([np.roll(loop, -1), loop, np.full(len(loop), count + k)], axis=1) for k, loop in enumerate(loops)]
    return replace(
        body, vertices=np.concatenate([body.vertices, middles], axis=1), faces=np.concatenate([body.faces, *fans])
    )


def _outwards(body: MeshSequence, flip: bool) -> MeshSequence:
    first, faces = torch.from_numpy(body.vertices[0]).double(), torch.from_numpy(body.faces)
    part = inspect_topology(faces, len(first)).part_of_vertex[faces[:, 0]]
    parts = torch.unique(part)
    inwards = [p for p in parts.tolist() if float(enclosed_volume(first, faces[part == p])) < 0]
    if not inwards:
        return body
    if not flip:
        which = "the body is" if len(inwards) == len(parts) else f"{len(inwards)} of the body's {len(parts)} parts are"
        raise ValueError(f"{which} inside out: the normals point inwards; turn the faces over, or add --flip-body")
    turned = torch.isin(part, torch.tensor(inwards)).numpy()
    return replace(body, faces=np.where(turned[:, None], body.faces[:, ::-1], body.faces))
