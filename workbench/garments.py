"""Sec. 4.3: a garment: template (draped on the mean body at rest) and material.  file or name -> (N,3), faces (M,3)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import outward_share, require_sheet
from workbench.geometry.winding import inside
from workbench.npz import read_npz
from workbench.store import atomic_write

SHIPPED = Path(__file__).parent / "assets" / "garments"
FORMAT = "garment-1"
FARTHEST = 0.5  # metres between a garment and the body; beyond it, units or axes are wrong


@dataclass(frozen=True, eq=False)
class Garment:
    """vertices: the template, where the garment rests on the canonical body; rest_vertices: stress-free material."""

    name: str
    vertices: Float[Tensor, "N 3"]
    rest_vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "M 3"]

    def __post_init__(self) -> None:
        if self.rest_vertices.shape != self.vertices.shape:
            raise ValueError(
                f"garment {self.name!r}: rest_vertices {tuple(self.rest_vertices.shape)} must have the shape of "
                f"vertices {tuple(self.vertices.shape)}"
            )
        require_sheet(self.vertices, self.faces, f"garment {self.name!r}")
        require_sheet(self.rest_vertices, self.faces, f"garment {self.name!r} at rest")

    def require_fits(self, body: Body) -> None:
        """Raises ValueError unless the template lies outside of the canonical body, near it, normals outwards."""
        surface, faces = body.template, body.faces
        distance = ClosestPoint(surface.numpy(), faces.numpy()).query(self.vertices.numpy()).distance
        if distance.min() > FARTHEST:
            raise ValueError(
                f"garment {self.name!r}: its nearest vertex is {distance.min():.1f} m away from the body; "
                "expected metres, z up, the body facing -y with its soles at z = 0"
            )
        within = int(inside(self.vertices.numpy(), surface.numpy(), faces.numpy()).sum())
        if within:
            raise ValueError(
                f"garment {self.name!r}: {within} of {len(self.vertices)} vertices are inside the body at frame 0; "
                "fit it to the canonical body (beta = 0, rest pose) first"
            )
        outward = outward_share(self.vertices, self.faces, surface, faces)
        if outward < 0.5:
            raise ValueError(
                f"garment {self.name!r}: inside out, {100 * (1 - outward):.0f} % of its area faces the body; "
                "flip its faces"
            )

    @property
    def ships(self) -> bool:
        """Whether this very garment is found by its name alone; others travel with what is trained for them."""
        return self.name in shipped_garments() and self is _shipped(self.name)

    def tensors(self) -> dict[str, Tensor]:
        """All but the name, for files that hold more than the garment."""
        named = {"vertices": self.vertices, "rest_vertices": self.rest_vertices, "faces": self.faces.int()}
        return {f"garment.{key}": tensor for key, tensor in named.items()}

    @staticmethod
    def from_tensors(name: str, found: Mapping[str, Tensor]) -> "Garment | None":
        """What `tensors` gave, or None where a file holds no garment.  Raises ValueError where half of it is there."""
        keys = [f"garment.{key}" for key in ("vertices", "rest_vertices", "faces")]
        missing = [key for key in keys if key not in found]
        if len(missing) == len(keys):
            return None
        if missing:
            raise ValueError(f"the file holds garment {name!r} without {', '.join(missing)}; make it again")
        vertices, rest, faces = (found[key] for key in keys)
        return Garment(name, vertices.float(), rest.float(), faces.long())

    def save(self, path: str | Path) -> None:
        """Own npz, float32, written whole or not at all."""
        arrays = {
            "format": np.array(FORMAT),
            "name": np.array(self.name),
            "vertices": self.vertices.numpy(),
            "rest_vertices": self.rest_vertices.numpy(),
            "faces": self.faces.numpy().astype(np.int32),
        }
        with atomic_write(path) as part:
            np.savez_compressed(part, **arrays)

    @staticmethod
    def load(source: str | Path, body: Body | None = None) -> "Garment":
        """A shipped garment by name, or an OBJ, PLY or npz file: metres, on the canonical `body` (default: ours).

        Meshes without a material rest shape are stress-free as they are. Vertex order and count are the file's.

        Raises:
            FileNotFoundError: neither a shipped name nor a file.
            ValueError: unreadable, not one manifold sheet, NaN, inside out, vertices inside the body.
        """
        if str(source) in shipped_garments():
            return _shipped(str(source))
        path = Path(source)
        if not path.is_file():
            raise FileNotFoundError(
                f"no garment {str(source)!r}: expected {', '.join(shipped_garments())}, or an OBJ, PLY or npz file"
            )
        garment = _read_own(path) if path.suffix.lower() == ".npz" else _read_mesh(path)
        garment.require_fits(Body.default() if body is None else body)
        return garment


def shipped_garments() -> tuple[str, ...]:
    """Names that `Garment.load` knows."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.npz")))


@cache
def _shipped(name: str) -> Garment:
    return _read_own(SHIPPED / f"{name}.npz")


def _read_own(path: Path) -> Garment:
    arrays = read_npz(path, "a garment", required=("format", "name", "vertices", "rest_vertices", "faces"))
    if str(arrays["format"]) != FORMAT:
        raise ValueError(f"{path} has format {str(arrays['format'])!r}; expected {FORMAT!r}")
    return Garment(
        name=str(arrays["name"]),
        vertices=torch.from_numpy(arrays["vertices"]).float(),
        rest_vertices=torch.from_numpy(arrays["rest_vertices"]).float(),
        faces=torch.from_numpy(arrays["faces"]).long(),
    )


def _read_mesh(path: Path) -> Garment:
    kind = path.suffix.lower()
    if kind not in (".obj", ".ply"):
        raise ValueError(f"{path}: expected a garment as .obj, .ply or .npz, got {kind or 'no suffix'}")
    try:
        # maintain_order: without it trimesh splits vertices along texture seams
        mesh: Any = trimesh.load(path, process=False, force="mesh", maintain_order=True)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not readable as a triangle mesh: {error}") from error
    if vertices.ndim != 2 or faces.ndim != 2 or not len(faces):
        raise ValueError(f"{path}: expected a triangle mesh, got {len(vertices)} vertices and no faces")
    points = torch.from_numpy(vertices.astype(np.float32))
    return Garment(path.stem, points, points, torch.from_numpy(faces.astype(np.int64)))
