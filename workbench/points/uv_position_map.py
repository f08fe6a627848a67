"""Sec. 3.1-3.2: the posed body on its UV square.  theta, beta -> position map I (3,H,W), queries u_i, p_i, T_i.

Everything of this package lives in the pelvis frame: the root joint at the origin and its turn about the vertical taken
off.  (The published data take off the root's whole rotation; ours keeps its tilt, so that a network can tell where down
is, which cloth knows.)
"""

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skinning import blended_affine
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_quaternion
from workbench.geometry.sampling import sample_surface
from workbench.geometry.uv_raster import pixel_centres, rasterise

INPUT_SIZE, QUERY_SIZE = 128, 256  # pixels of I and of the queries; facts.md 2
BUILD_GAIN = 5.0  # of what sets a body apart from the mean shape, centimetres, beside positions, decimetres; ours


@dataclass(frozen=True, eq=False)
class SurfaceQueries:
    """Points u_i of the body surface at which clothes are asked for: on the UV square and on the mesh."""

    u: Float[Tensor, "N 2"]  # in [0, 1]
    corners: Int[Tensor, "N 3"]  # the body vertices around each point ...
    barycentric: Float[Tensor, "N 3"]  # ... and their weights

    def __len__(self) -> int:
        return len(self.u)

    def subset(self, index: Int[Tensor, " M"]) -> "SurfaceQueries":
        return SurfaceQueries(self.u[index], self.corners[index], self.barycentric[index])

    def to(self, device: torch.device) -> "SurfaceQueries":
        """The same on a device."""
        return SurfaceQueries(self.u.to(device), self.corners.to(device), self.barycentric.to(device))

    def interpolate(self, attributes: Float[Tensor, "*B V c"]) -> Float[Tensor, "*B N c"]:
        """Attributes of the body's vertices at the points (p_i, T_i: barycentric, so continuous)."""
        gathered = attributes[..., self.corners.reshape(-1), :].unflatten(-2, self.corners.shape)
        return (gathered * self.barycentric[..., None]).sum(-2)


@dataclass(frozen=True, eq=False)
class Atlas:
    """Which pixels of an n x n map show the body, and which points of it they show."""

    size: int
    pixel: Int[Tensor, " N"]  # row * size + column
    queries: SurfaceQueries

    def to(self, device: torch.device) -> "Atlas":
        """The same on a device."""
        return Atlas(self.size, self.pixel.to(device), self.queries.to(device))

    def map_of(self, attributes: Float[Tensor, "*B V c"]) -> Float[Tensor, "*B c H W"]:
        """Vertex attributes as images; zero where there is no body."""
        values = self.queries.interpolate(attributes).mT
        image = values.new_zeros(*values.shape[:-1], self.size * self.size)
        image[..., self.pixel] = values
        return image.unflatten(-1, (self.size, self.size))


def atlas_of(body: Body, size: int) -> Atlas:
    """The points of the body at the pixel centres of an n x n map (every pixel centre inside of a chart).

    Raises:
        ValueError: the body has no texture coordinates, or they overlap or leave the unit square.
    """
    uv, uv_faces = _texture(body)
    try:
        raster = rasterise(uv, uv_faces, size)
    except ValueError as error:
        raise ValueError(f"body {body.name!r}: {error}") from error
    queries = SurfaceQueries(
        u=torch.from_numpy(pixel_centres(raster.pixel, size)).float(),
        corners=body.faces[torch.from_numpy(raster.face)],
        barycentric=torch.from_numpy(raster.barycentric),
    )
    return Atlas(size, torch.from_numpy(raster.pixel), queries)


def pixel_grid(size: int) -> Float[Tensor, "N 2"]:
    """u of every pixel of an n x n map, row by row, whether it shows the body or not."""
    return torch.from_numpy(pixel_centres(np.arange(size * size), size)).float()


def scattered_queries(body: Body, count: int, generator: np.random.Generator) -> SurfaceQueries:
    """Any number of points, uniform by area on the body at rest: clothes at any density.

    Raises ValueError for a body without texture coordinates.
    """
    uv, uv_faces = _texture(body)
    vertices, faces = body.template.numpy(), body.faces.numpy()
    samples = sample_surface(vertices, faces, count, generator)
    a, b, c = vertices[faces[samples.face]].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(1) + 1e-30
    first = (np.cross(b - samples.point, c - samples.point) * normal).sum(1) / area
    second = (np.cross(c - samples.point, a - samples.point) * normal).sum(1) / area
    weights = np.clip(np.stack([first, second, 1 - first - second], 1), 0, 1)
    weights /= weights.sum(1, keepdims=True)
    return SurfaceQueries(
        u=torch.from_numpy(np.einsum("nk,nki->ni", weights, uv[uv_faces[samples.face]])).float(),
        corners=body.faces[torch.from_numpy(samples.face)],
        barycentric=torch.from_numpy(weights).float(),
    )


@dataclass(frozen=True, eq=False)
class PosedBodies:
    """B bodies in the pelvis frame: what a point model knows of its frames."""

    neutral: Float[Tensor, "B V 3"]  # of the mean shape
    build: Float[Tensor, "B V 3"]  # at rest: the subject's own shape less the mean shape, pelvis on pelvis
    vertices: Float[Tensor, "B V 3"]  # of the subject's own shape
    transforms: Float[Tensor, "B V 3 3"]  # the blended rotation that skinning applies at each vertex

    def __len__(self) -> int:
        return len(self.vertices)

    def at(self, index: int | slice | Tensor) -> "PosedBodies":
        """Some of the frames."""
        index = slice(index, index + 1) if isinstance(index, int) else index
        return PosedBodies(self.neutral[index], self.build[index], self.vertices[index], self.transforms[index])

    @property
    def seen(self) -> Float[Tensor, "B V 6"]:
        """What a pose encoder may see: the neutral body, and the build.  The published one sees the first three."""
        return torch.cat([self.neutral, BUILD_GAIN * self.build], dim=-1)


@dataclass(frozen=True, eq=False)
class PosedQueries:
    """p_i and T_i of Eq. 2 at the query points u_i of B bodies."""

    u: Float[Tensor, "N 2"]
    points: Float[Tensor, "B N 3"]
    transforms: Float[Tensor, "B N 3 3"]


def posed_bodies(body: Body, rotations: Float[Tensor, "B J 3 3"], betas: Float[Tensor, "*B K"]) -> PosedBodies:
    """Bodies of shape beta in pose theta, and the neutral shape in the same pose."""
    local = _tilted(rotations)
    own = body.pose(local, betas)
    transforms, _ = blended_affine(body.weights, own.transforms)
    return PosedBodies(
        neutral=neutral_bodies(body, rotations),
        build=builds(body, betas).expand(len(rotations), -1, -1),
        vertices=body.vertices(local, betas) - own.joints[..., :1, :],
        transforms=transforms,
    )


def neutral_bodies(body: Body, rotations: Float[Tensor, "B J 3 3"]) -> Float[Tensor, "B V 3"]:
    """The mean shape in these poses, in the pelvis frame: what a pose encoder sees."""
    local, mean = _tilted(rotations), body.mean_shape()
    return body.vertices(local, mean) - body.pose(local, mean).joints[..., :1, :]


def builds(body: Body, betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B V 3"]:
    """What sets bodies apart from the mean shape at rest, pelvis on pelvis."""
    mean = body.mean_shape()
    pelvis = (body.joints(betas) - body.joints(mean))[..., :1, :]
    return body.shape_offsets(betas) - body.shape_offsets(mean) - pelvis


def _tilted(rotations: Float[Tensor, "B J 3 3"]) -> Float[Tensor, "B J 3 3"]:
    """The pose without its heading."""
    local = rotations.clone()
    local[:, 0] = without_heading(rotations[:, 0])
    return local


def posed_queries(queries: SurfaceQueries, bodies: PosedBodies) -> PosedQueries:
    """p_i and T_i, barycentric between the body's vertices."""
    transforms = queries.interpolate(bodies.transforms.flatten(-2)).unflatten(-1, (3, 3))
    return PosedQueries(queries.u, queries.interpolate(bodies.vertices), transforms)


def heading(rotation: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The part of a rotation that turns about the vertical (swing-twist: R = heading @ tilt)."""
    w, _, _, z = matrix_to_quaternion(rotation).unbind(-1)
    zero = torch.zeros_like(w)
    return axis_angle_to_matrix(torch.stack([zero, zero, 2 * torch.atan2(z, w)], -1))


def without_heading(rotation: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The tilt alone: what is left once the turn about the vertical is taken off on the left."""
    return heading(rotation).mT @ rotation


@dataclass(frozen=True, eq=False)
class PelvisFrame:
    """Where the pelvis frame stands in the world: world = rotation @ local + origin."""

    rotation: Float[Tensor, "*B 3 3"]
    origin: Float[Tensor, "*B 3"]

    def to_local(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 3"]:
        return (points - self.origin[..., None, :]) @ self.rotation

    def to_world(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N 3"]:
        return points @ self.rotation.mT + self.origin[..., None, :]


def pelvis_frame(
    body: Body,
    rotations: Float[Tensor, "*B J 3 3"],
    betas: Float[Tensor, "*S K"],
    translation: Float[Tensor, "*B 3"],
) -> PelvisFrame:
    """The pelvis frame of a body that moves through the world."""
    root = body.joints(betas)[..., 0, :] + translation
    return PelvisFrame(heading(rotations[..., 0, :, :]), root)


def atlas_fingerprint(body: Body) -> str:
    """What a points model was trained for: a hash of the body's surface, its atlas and its skinning."""
    uv, uv_faces = _texture(body)
    digest = hashlib.sha256()
    for array in (body.template.numpy(), body.faces.numpy(), uv, uv_faces, body.weights.numpy()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _texture(body: Body) -> tuple[Float[np.ndarray, "U 2"], Int[np.ndarray, "F 3"]]:
    if body.uv is None or body.uv_faces is None:
        raise ValueError(
            f"body {body.name!r} has no texture coordinates, which the points model needs; give it arrays `uv` (U,2) "
            "and `uv_faces` (F,3), or use the default body"
        )
    return body.uv.numpy(), body.uv_faces.numpy()
