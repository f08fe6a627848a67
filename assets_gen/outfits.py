"""Sec. 4's outfits: garments put on over each other and simulated as one cloth.  garments -> merged mesh.

One mesh with several parts, so that self-contact keeps the layers in their order; parts share no vertex. An outfit of
one garment is that garment.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from assets_gen.motions import generate
from assets_gen.simulations import RecordConfig, Task
from workbench.body.model import Body
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import face_normals
from workbench.npz import read_npz
from workbench.store import atomic_write

log = logging.getLogger(__name__)

LAYER_GAP = 0.007  # metres between two layers before they fall; self-contact keeps 3 mm
NEARBY = 0.05  # metres; further from the inner layer a vertex has nothing to clear
CLEARING_STEPS = 20
FORMAT = "outfit-1"


@dataclass(frozen=True)
class Ensemble:
    """Garments worn together, by name, from the innermost outwards."""

    name: str
    layers: tuple[str, ...]
    held_out: bool = False  # no training sees it: what unseen scans are made of


# ours: single garments and what goes over what; two are kept for the unseen scan (issue 5)
ENSEMBLES = (
    Ensemble("tshirt", ("tshirt",)),
    Ensemble("longsleeve", ("longsleeve",)),
    Ensemble("dress", ("dress",)),
    Ensemble("tshirt-trousers", ("trousers", "tshirt")),
    Ensemble("tshirt-shorts", ("shorts", "tshirt")),
    Ensemble("tshirt-skirt", ("skirt", "tshirt")),
    Ensemble("longsleeve-trousers", ("trousers", "longsleeve")),
    Ensemble("longsleeve-skirt", ("skirt", "longsleeve")),
    Ensemble("tank-trousers", ("trousers", "tank")),
    Ensemble("tank-shorts", ("shorts", "tank")),
    Ensemble("longsleeve-shorts", ("shorts", "longsleeve"), held_out=True),
    Ensemble("tank-skirt", ("skirt", "tank"), held_out=True),
)


@dataclass(frozen=True, eq=False)
class Outfit:
    """Several garments as one cloth; the fields that a simulation reads are those of a `Garment`."""

    name: str
    vertices: Float[Tensor, "N 3"]  # where it rests on the canonical body
    rest_vertices: Float[Tensor, "N 3"]  # stress-free material
    faces: Int[Tensor, "M 3"]
    garment_of_vertex: Int[Tensor, " N"]  # which layer each vertex belongs to, 0 the innermost
    garments: tuple[str, ...]  # names of the layers

    def save(self, path: str | Path) -> None:
        """Own npz, written whole or not at all."""
        with atomic_write(path) as part:
            np.savez_compressed(
                part,
                format=np.array(FORMAT),
                name=np.array(self.name),
                vertices=self.vertices.numpy(),
                rest_vertices=self.rest_vertices.numpy(),
                faces=self.faces.numpy().astype(np.int32),
                garment_of_vertex=self.garment_of_vertex.numpy().astype(np.uint8),
                garments=np.array(self.garments),
            )

    @staticmethod
    def load(path: str | Path) -> "Outfit":
        """Raises FileNotFoundError, or ValueError for another file."""
        keys = ("format", "name", "vertices", "rest_vertices", "faces", "garment_of_vertex", "garments")
        arrays = read_npz(path, "an outfit", required=keys)
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"{path} has format {str(arrays['format'])!r}; expected {FORMAT!r}")
        return Outfit(
            name=str(arrays["name"]),
            vertices=torch.from_numpy(arrays["vertices"]),
            rest_vertices=torch.from_numpy(arrays["rest_vertices"]),
            faces=torch.from_numpy(arrays["faces"]).long(),
            garment_of_vertex=torch.from_numpy(arrays["garment_of_vertex"]).long(),
            garments=tuple(str(name) for name in arrays["garments"]),
        )


def merged(name: str, garments: Sequence[Garment]) -> Outfit:
    """Garments side by side in one mesh, in their order."""
    first = np.cumsum([0, *[len(garment.vertices) for garment in garments[:-1]]])
    return Outfit(
        name=name,
        vertices=torch.cat([garment.vertices for garment in garments]),
        rest_vertices=torch.cat([garment.rest_vertices for garment in garments]),
        faces=torch.cat([garment.faces + int(start) for garment, start in zip(garments, first, strict=True)]),
        garment_of_vertex=torch.cat([torch.full((len(g.vertices),), k) for k, g in enumerate(garments)]),
        garments=tuple(garment.name for garment in garments),
    )


def put_on(ensemble: Ensemble, garments: Sequence[Garment]) -> Outfit:
    """The layers before they fall together: the innermost draped, each further one as cut, cleared of those below.

    Raises ValueError where an outer layer cannot be brought outside of an inner one.
    """
    worn = list(garments[:1])
    for outer in garments[1:]:
        start = outer.rest_vertices.numpy().astype(np.float64)
        for inner in worn:
            start = cleared(start, outer.faces.numpy(), inner.vertices.numpy(), inner.faces.numpy())
            below = behind(start, inner.vertices.numpy(), inner.faces.numpy(), NEARBY)
            if below.any():
                raise ValueError(
                    f"outfit {ensemble.name!r}: {int(below.sum())} vertices of {outer.name!r} start behind "
                    f"{inner.name!r}; cut the outer one looser or the inner one closer"
                )
        placed = torch.from_numpy(start).float()
        worn.append(Garment(outer.name, placed, outer.rest_vertices, outer.faces))
    return merged(ensemble.name, worn)


def cleared(
    vertices: Float[np.ndarray, "N 3"],
    faces: Int[np.ndarray, "M 3"],
    inner: Float[np.ndarray, "K 3"],
    inner_faces: Int[np.ndarray, "L 3"],
    gap: float = LAYER_GAP,
) -> Float[np.ndarray, "N 3"]:
    """Outer vertices that are closer than `gap` to the inner layer, or behind it, moved off it along its normals.

    The push is spread over neighbours, so that a hem does not get teeth.
    """
    closest = ClosestPoint(inner, inner_faces)
    normals = face_normals(torch.from_numpy(inner).float(), torch.from_numpy(inner_faces)).numpy()
    sides = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    degree = np.bincount(sides[:, 0], minlength=len(vertices)).clip(1)[:, None]
    for _ in range(CLEARING_STEPS):
        height, normal, near = _heights(vertices, closest, normals)
        missing = np.where(near, np.maximum(gap - height, 0), 0)[:, None] * normal
        if not missing.any():
            break
        around = np.zeros_like(vertices)
        np.add.at(around, sides[:, 0], missing[sides[:, 1]])
        vertices = vertices + missing + 0.3 * around / degree
    return vertices


def behind(
    vertices: Float[np.ndarray, "N 3"],
    inner: Float[np.ndarray, "K 3"],
    inner_faces: Int[np.ndarray, "L 3"],
    reach: float,
) -> np.ndarray:
    """Which vertices lie within `reach` of a layer, on its inner side."""
    normals = face_normals(torch.from_numpy(inner).float(), torch.from_numpy(inner_faces)).numpy()
    height, _, near = _heights(vertices, ClosestPoint(inner, inner_faces), normals, reach)
    return near & (height < 0)


def _heights(
    vertices: np.ndarray, closest: ClosestPoint, normals: np.ndarray, reach: float = NEARBY
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height over the layer, its normal there, and whether the layer is near and not merely its border."""
    found = closest.query(vertices)
    normal = normals[found.face]
    offset = vertices - found.point
    height = (offset * normal).sum(1)
    # beyond a border the offset leans away from the normal: there is no layer underneath
    over = np.abs(height) > 0.5 * np.linalg.norm(offset, axis=1) - 1e-6
    return height, normal, over & (found.distance < reach)


def task_of(
    outfit: Outfit, motion: str, frames: int, betas: Float[Tensor, " K"], body: Body, record: RecordConfig
) -> Task:
    """One simulation of an outfit over a generated motion, for `assets_gen.simulations.simulate`."""
    return Task(
        name=f"{outfit.name}-{motion}",
        motion=generate(motion, body.skeleton, frames=frames),
        betas=betas,
        # a simulation reads name, vertices, rest_vertices and faces, which both have; a Garment must be one sheet
        garment=cast(Garment, outfit),
        clear=True,
        record=record,
    )
