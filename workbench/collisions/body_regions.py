"""Names for places on a body: vertices (V,3), faces (F,3), weights (V,J) -> a region for each vertex."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from workbench.body.model import Body
from workbench.geometry.mesh import inspect_topology

PATCHES = 16  # ours: as many places as people tell apart on a body, and as rows fit a screen
MOST_VERTICES = 200_000  # ours: beyond it, walking the surface for patches takes longer than the inspection
LARGEST_PARTS = 24

# The default body's joints, gathered: twist and finger joints are no places that people look for.
PLACES = {
    "pelvis": ("Hips", "LHipJoint", "RHipJoint"),
    "belly": ("LowerBack", "Spine"),
    "chest": ("Spine1",),
    "neck": ("Neck", "Neck1"),
    "head": ("Head",),
} | {
    f"{side} {place}": tuple(joint.replace("?", side.capitalize()).replace("!", side[0].upper()) for joint in joints)
    for place, joints in {
        "shoulder": ("?Shoulder",),
        "upper arm": ("?Arm",),
        "forearm": ("?ForeArm",),
        "hand": ("?Hand", "!Thumb", "?FingerBase", "?HandFinger1"),
        "thigh": ("?UpLeg",),
        "shin": ("?Leg",),
        "foot": ("?Foot", "?ToeBase"),
    }.items()
    for side in ("left", "right")
}


@dataclass(frozen=True, eq=False)
class BodyRegions:
    """A named region for each body vertex; `source` says where they come from."""

    names: tuple[str, ...]
    of_vertex: Int[Tensor, "V"]
    source: str


def regions_of(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], model: Body | None = None) -> BodyRegions:
    """The best names there are: the model's (the default body's, where it is its mesh), else the connected parts, else
    patches of the surface, else the whole body.

    Errors: ValueError where `model` is given and has another number of vertices.
    """
    if model is not None and len(model.weights) != len(vertices):
        raise ValueError(
            f"the body has {len(vertices)} vertices, but the model '{model.name}' has {len(model.weights)}: "
            "its regions cannot be used"
        )
    known = Body.default() if model is None else model
    if model is not None or (faces.shape == known.faces.shape and torch.equal(faces, known.faces)):
        return regions_from_weights(known.weights, known.joint_names, f"skinning weights of '{known.name}'")
    topology = inspect_topology(faces, len(vertices))
    if 1 < topology.parts <= LARGEST_PARTS:
        used = torch.zeros(len(vertices), dtype=torch.bool)
        used[faces.reshape(-1)] = True
        part = torch.unique(topology.part_of_vertex[used], return_inverse=True)[1]
        of_vertex = torch.zeros(len(vertices), dtype=torch.int64)
        of_vertex[used] = part
        return BodyRegions(tuple(f"part {k + 1}" for k in range(topology.parts)), of_vertex, "connected parts")
    if len(vertices) > MOST_VERTICES:
        return BodyRegions(("whole body",), torch.zeros(len(vertices), dtype=torch.int64), "none: too many vertices")
    return surface_patches(vertices, topology.edges)


def regions_from_weights(weights: Float[Tensor, "V J"], joint_names: tuple[str, ...], source: str) -> BodyRegions:
    """The joint that moves a vertex most; joints with CMU names are gathered into places."""
    place_of = {joint: place for place, joints in PLACES.items() for joint in joints}
    places = [place_of.get(name, name) for name in joint_names]
    order = [place for place in PLACES if place in places]
    order += list(dict.fromkeys(place for place in places if place not in PLACES))
    to_place = torch.tensor([order.index(place) for place in places])
    return BodyRegions(tuple(order), to_place[weights.argmax(dim=1)], source)


def surface_patches(vertices: Float[Tensor, "V 3"], edges: Int[Tensor, "E 2"], count: int = PATCHES) -> BodyRegions:
    """About equal patches: centres as far from each other as the surface allows, each vertex to its nearest along it.

    Named by where their centres are: "patch 3 (0.42, -0.10, 1.31)", the coordinates being those of the first frame.
    """
    ends = edges.numpy()
    lengths = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).double().numpy()
    graph = coo_matrix((np.maximum(lengths, 1e-12), (ends[:, 0], ends[:, 1])), shape=(len(vertices),) * 2).tocsr()
    nearest = np.full(len(vertices), np.inf)
    of_vertex = np.zeros(len(vertices), np.int64)
    centre = int(vertices[:, 2].argmax())  # the top of it, so that the same mesh always gives the same patches
    centres: list[int] = []
    while len(centres) < count:
        away = dijkstra(graph, directed=False, indices=centre)
        closer = away < nearest
        of_vertex[closer] = len(centres)
        nearest = np.minimum(nearest, away)
        centres.append(centre)
        reachable = np.where(np.isfinite(nearest), nearest, -1.0)
        centre = int(reachable.argmax())
        if reachable[centre] <= 0:
            break
    places = ["({:.2f}, {:.2f}, {:.2f})".format(*vertices[c].tolist()) for c in centres]
    names = tuple(f"patch {k + 1} {place}" for k, place in enumerate(places))
    return BodyRegions(names, torch.from_numpy(of_vertex), "patches of the surface: the body has no known weights")
