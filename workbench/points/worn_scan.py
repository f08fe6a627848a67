"""A scan file and the body in it -> both in the pelvis frame, as Eq. 7 wants them.  .npz, .ply, .obj; theta, beta.

What the file lacks and had to be made is in `remarks`; what cannot be guessed (unit, axis, place) is proposed in the
error and given by the caller.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
import tyro
from jaxtyping import Float, Float32
from scipy.spatial import KDTree
from torch import Tensor

from workbench.body.model import Body
from workbench.formats import load_motion
from workbench.formats.scans import NEIGHBOURS, Axis, Scan, Unit, read_scan
from workbench.geometry.chamfer import NearestPoint
from workbench.geometry.mesh import vertex_normals
from workbench.npz import read_npz
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.uv_position_map import PelvisFrame, PosedBodies, pelvis_frame, posed_bodies

FARTHEST = 0.08  # metres that the body's surface may lie off the scan, at the median, before it is called misaligned
ROUNDS = 4  # of votes among neighbours about a normal's sign
ALIKE = 0.01  # metres: proposals that lie this near to the best are as good
FEWEST = 1000  # points of a scan that clothes can be told from


@dataclass(frozen=True, eq=False)
class WornScan:
    """A scan and its body in the pelvis frame, and how they lie in the world."""

    name: str
    scan: ScanFrame
    bodies: PosedBodies  # one
    betas: Float[Tensor, " K"]
    frame: PelvisFrame
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScanSource:
    """A scan, and how to read it."""

    # .ply or .obj (points or a mesh), or a scan sequence of ours (.npz), which has its body with it.
    file: tyro.conf.Positional[Path]
    # The pose of the body in the scan: any motion file. The body's rest pose (arms 45 degrees down) when absent.
    pose: Path | None = None
    # Which frame of the sequence or of the pose file, from 0.
    frame: int = 0
    # The shape of the body in the scan, up to 10 numbers in standard deviations, with commas; what is left out is 0.
    betas: str = ""
    # What the file's numbers are.
    unit: Unit = "m"
    # Which axis of the file points up.
    up: Axis = "z"
    # Move the scan so that it stands where the body stands.
    place: bool = False


def read_worn_scan(source: ScanSource, body: Body) -> WornScan:
    """Raises FileNotFoundError, or ValueError for what cannot be used, in one line that says what would help."""
    if source.file.suffix.lower() == ".npz":
        return _of_sequence(source, body)
    scan = read_scan(source.file, unit=source.unit, up=source.up)
    betas = betas_from_words(source.betas, body)
    rotations, translation = _pose(source, body)
    frame = pelvis_frame(body, rotations, betas, translation)
    bodies = posed_bodies(body, rotations[None], betas)
    points = frame.to_local(torch.from_numpy(scan.points))
    if source.place:
        points = points + shift_onto(points, bodies)
    local = ScanFrame(points, torch.from_numpy(scan.normals) @ frame.rotation)
    other: Axis = "y" if source.up == "z" else "z"
    turned = frame.to_local(torch.from_numpy(_other_axis_up(scan.points, source.up)))
    require_aligned(
        local, bodies, {f"--up {other}": turned, f"--up {other} --place": turned + shift_onto(turned, bodies)}
    )
    if scan.estimated:
        local = facing_out(local, bodies, body)
    return WornScan(scan.name, local, bodies, betas, frame, scan.remarks)


def world_scan(worn: WornScan, cloud: ScanFrame) -> Scan:
    """A cloud of the pelvis frame back where the scan was."""
    points = worn.frame.to_world(cloud.points).numpy()
    return Scan(points, (cloud.normals @ worn.frame.rotation.mT).numpy(), worn.name)


def require_aligned(scan: ScanFrame, bodies: PosedBodies, others: Mapping[str, Tensor] = MappingProxyType({})) -> None:
    """Raises ValueError unless most of the body lies near the scan: points cannot tell a body from its clothes.

    others: the points as other options would have them, each of which is proposed if it helps.
    """
    if len(bodies) != 1:
        raise ValueError(f"a scan has one body, got {len(bodies)}")
    if len(scan.points) < FEWEST:
        raise ValueError(f"the scan has {len(scan.points)} points; expected thousands, at least {FEWEST}")
    off = median_distance(scan.points, bodies)
    if off <= FARTHEST:
        return
    ways = {"--place": scan.points + shift_onto(scan.points, bodies), **others}
    found = {options: median_distance(points, bodies) for options, points in ways.items()}
    good = [options for options in found if found[options] <= min(found.values()) + ALIKE]
    best = min(good, key=len)  # the fewest words
    remedy = (
        f"with {best} it would lie {100 * found[best]:.1f} cm off"
        if found[best] <= FARTHEST
        else "give the pose and shape of the body in this scan (--pose, --betas)"
    )
    raise ValueError(
        f"the body lies {100 * off:.0f} cm off the scan (median; expected at most {100 * FARTHEST:.0f} cm): {remedy}"
    )


def facing_out(scan: ScanFrame, bodies: PosedBodies, body: Body) -> ScanFrame:
    """Normals turned to the side that the body's own normal, at its nearest point, points to.

    Where clothes stand across that normal (a skirt between the legs) the neighbours decide.
    """
    points, surface = scan.points.numpy(), bodies.vertices[0]
    body_normals = vertex_normals(surface, body.faces)
    nearest = torch.from_numpy(NearestPoint(surface.numpy())(points))
    agreement = (scan.normals * body_normals[nearest]).sum(1)
    normals = scan.normals * torch.where(agreement < 0, -1.0, 1.0)[:, None]
    around = torch.from_numpy(np.asarray(KDTree(points).query(points, NEIGHBOURS + 1)[1]))
    weight = agreement.abs()[:, None]  # a clear verdict outvotes a doubtful one
    for _ in range(ROUNDS):
        said = (normals * weight)[around].sum(1)
        normals = normals * torch.where((normals * said).sum(1) < 0, -1.0, 1.0)[:, None]
    return ScanFrame(scan.points, normals)


def median_distance(points: Float[Tensor, "N 3"], bodies: PosedBodies) -> float:
    """Metres from the body's vertices to the scan, at the median."""
    surface = bodies.vertices[0]
    nearest = points[torch.from_numpy(NearestPoint(points.numpy())(surface.numpy()))]
    return float((surface - nearest).norm(dim=1).median())


def shift_onto(points: Float[Tensor, "N 3"], bodies: PosedBodies) -> Float[Tensor, "3"]:
    """What brings the middle of a scan's box over the body's, and its soles to the body's."""
    surface = bodies.vertices[0]
    shift = (surface.amin(0) + surface.amax(0) - points.amin(0) - points.amax(0)) / 2
    shift[2] = surface[:, 2].min() - points[:, 2].min()
    return shift


def betas_from_words(words: str, body: Body) -> Float[Tensor, " K"]:
    """ "1,-0.5" -> a full shape vector.  Raises ValueError for what is no number, or too many."""
    try:
        given = [float(word) for word in words.split(",") if word.strip()]
    except ValueError as error:
        raise ValueError(f"--betas {words!r} must be numbers with commas, such as 1,-0.5,2") from error
    if len(given) > body.shape_count:
        raise ValueError(f"{len(given)} betas given, but the body has {body.shape_count} shape components")
    if not np.isfinite(given).all():
        raise ValueError(f"--betas {words!r} holds NaN or infinity")
    full = body.mean_shape()
    full[: len(given)] = torch.tensor(given)
    return full


def _other_axis_up(points: Float32[np.ndarray, "N 3"], up: Axis) -> Float32[np.ndarray, "N 3"]:
    """Points that were read with `up` up, as if the other axis were."""
    x, y, z = points.T
    return np.stack([x, -z, y] if up == "z" else [x, z, -y], 1)


def _of_sequence(source: ScanSource, body: Body) -> WornScan:
    if "scan_pc" in read_npz(source.file, "a scan sequence"):
        raise ValueError(
            f"{source.file} is a packed scan of the published data, whose body is of another family; write its points "
            "as .ply (formats.scans.read_packed_scan, write_scan) and give the pose and shape of body "
            f"{body.name!r} in it"
        )
    if source.pose is not None or source.betas:
        raise ValueError(f"{source.file} has its pose and shape with it: leave out --pose and --betas")
    sequence = ScanSequence.load(source.file)
    if not 0 <= source.frame < len(sequence):
        raise ValueError(f"{source.file} has {len(sequence)} scans, counted from 0; got --frame {source.frame}")
    rotations = sequence.rotations[source.frame]
    scan, bodies = sequence.frame(source.frame), posed_bodies(body, rotations[None], sequence.betas)
    require_aligned(scan, bodies)
    here = PelvisFrame(torch.eye(3), torch.zeros(3))
    return WornScan(f"{sequence.outfit}_{sequence.motion}_{source.frame}", scan, bodies, sequence.betas, here)


def _pose(source: ScanSource, body: Body) -> tuple[Float[Tensor, "J 3 3"], Float[Tensor, "3"]]:
    if source.pose is None:
        return body.rest_rotations(), torch.zeros(3)
    motion = load_motion(source.pose, body)
    if not 0 <= source.frame < len(motion):
        raise ValueError(f"{source.pose} has {len(motion)} frames, counted from 0; got --frame {source.frame}")
    return motion.rotations[source.frame], motion.translation[source.frame]
