"""Cloth over a moving body by Newton's SolverStyle3D.  body (V,3), rest shape (N,3) -> cloth (N,3).

The body is a collider whose vertices are given; the garment is an isotropic fabric, stress-free in its rest shape and
flat in bending. Parameters: facts.md 4 and measurements noted beside them.
"""

import logging
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from workbench.extras import require
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.winding import InsideTest, inside

log = logging.getLogger(__name__)

MENDING_ROUNDS = 6  # leaving one surface may lead into another
UNTANGLING = 1.0  # Newton's default weight of edge-face untangling


@dataclass(frozen=True)
class ClothConfig:
    """A light jersey. Units: kg, m, s, N."""

    fps: float = 30.0  # facts.md 1
    substeps: int = 6  # facts.md 4; 8 for fast motion
    iterations: int = 5
    linear_iterations: int = 15
    density: float = 0.2  # kg/m^2
    stretch: float = 60.0  # N/m; facts.md 4: above 200 these iterations do not converge and it looks like a stiff shell
    shear: float = 12.0
    area: float = 30.0
    bend: float = 1e-6  # N m
    stretch_damping: float = 1e-4
    bend_damping: float = 1e-3
    thickness: float = 0.005  # metres between cloth and body; facts.md 4: 4 mm leaves 0.08 % inside, 5-6 mm none
    self_thickness: float = 0.003  # half of it; below a quarter of the mean edge
    contact_stiffness: float = 1e4
    contact_damping: float = 1e-4
    friction: float = 0.3
    detection: float = 0.01  # metres of slack; more than the body moves in a substep
    untangle_every: int = 6  # substeps; ours: in every one it takes a third of the time, for the same result
    mend_depth: float = 0.01  # metres; a vertex squeezed into the body by no more than this is put back outside
    mend_gap: float = 0.001  # metres off the body at which it is put
    fastest: float = 30.0  # m/s; a vertex faster than this means divergence
    device: str = "cpu"


class ClothSolver:
    """One garment on one body; `advance(body)` simulates one frame, in which the body moves straight to `body`."""

    def __init__(
        self,
        body_vertices: Float[np.ndarray, "V 3"],
        body_faces: Int[np.ndarray, "F 3"],
        rest_vertices: Float[np.ndarray, "N 3"],
        faces: Int[np.ndarray, "M 3"],
        start_vertices: Float[np.ndarray, "N 3"] | None = None,
        config: ClothConfig = ClothConfig(),
    ):
        """rest_vertices: stress-free shape; start_vertices: where the cloth is at frame 0 (default: the rest shape).

        Raises:
            ValueError: the cloth starts with vertices inside the body.
        """
        newton: Any = require("newton", extra="assets")
        start = np.asarray(rest_vertices if start_vertices is None else start_vertices, np.float32)
        require_outside(start, body_vertices, body_faces)
        self.config, self.frame, self.mended = config, 0, 0
        self._inside = InsideTest(np.asarray(body_vertices), np.asarray(body_faces))
        self._closest = ClosestPoint(np.asarray(body_vertices), np.asarray(body_faces))
        self._body_faces = self._closest.faces
        self._positions, self._body = start, np.asarray(body_vertices, np.float32)
        with wp.ScopedDevice(config.device):
            self._build(newton, np.asarray(body_faces), np.asarray(rest_vertices, float), np.asarray(faces))

    def _build(self, newton: Any, body_faces: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> None:
        config, solvers = self.config, newton.solvers
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, -9.81))
        solvers.SolverStyle3D.register_custom_attributes(builder)
        panels = flat_panels(rest, faces)
        still = wp.vec3(0.0, 0.0, 0.0)
        solvers.style3d.add_cloth_mesh(
            builder,
            pos=still,
            rot=wp.quat_identity(),
            vel=still,
            vertices=self._positions.tolist(),
            indices=faces.ravel().tolist(),
            panel_verts=panels.tolist(),
            panel_indices=list(range(len(panels))),
            density=config.density,
            tri_aniso_ke=wp.vec3(config.stretch, config.stretch, config.shear),
            edge_aniso_ke=wp.vec3(config.bend, config.bend, config.bend),
            tri_ka=config.area,
            tri_kd=config.stretch_damping,
            edge_kd=config.bend_damping,
            particle_radius=config.thickness,
        )
        self._mesh = newton.Mesh(self._body, body_faces.astype(np.int32).ravel(), compute_inertia=False, is_solid=True)
        material = newton.ModelBuilder.ShapeConfig()
        material.mu, material.has_shape_collision = config.friction, False
        builder.add_shape_mesh(body=-1, xform=wp.transform_identity(), mesh=self._mesh, cfg=material)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = builder.finalize()
        model.soft_contact_ke = config.contact_stiffness
        model.soft_contact_kd = config.contact_damping
        model.soft_contact_mu = config.friction
        model.shape_material_mu.fill_(config.friction)
        # The culling boxes are those of frame 0: a body that walks out of them would lose its contacts.
        for box, side in ((model.shape_collision_aabb_lower, -1.0), (model.shape_collision_aabb_upper, 1.0)):
            box.assign(np.full((model.shape_count, 3), 50.0 * side, np.float32))
        self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=config.detection)
        self._contacts = self._pipeline.contacts()
        settings = solvers.SolverStyle3D.Config(
            iterations=config.iterations, linear_iterations=config.linear_iterations
        )
        self._solver = solvers.SolverStyle3D(model, config=settings)
        self._solver.collision.radius = config.self_thickness
        self._solver.collision.body_contact_max = self._contacts.soft_contact_max
        self._states, self._control = [model.state(), model.state()], model.control()
        self._substeps: dict[tuple[int, bool], Any] = {}

    @property
    def positions(self) -> Float[np.ndarray, "N 3"]:
        return self._positions

    def advance(self, body_vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "N 3"]:
        """Simulate 1/fps seconds while the body moves from its last vertices to these; returns the garment.

        Raises:
            ValueError: the simulation diverged: a vertex is NaN or faster than `fastest`.
        """
        config, steps = self.config, self.config.substeps
        target = np.asarray(body_vertices, np.float32)
        with wp.ScopedDevice(config.device):
            before, after = wp.array(self._body, dtype=wp.vec3), wp.array(target, dtype=wp.vec3)
            self._solver.rebuild_bvh(self._states[0])
            for step in range(steps):
                moving = [before, after, (step + 1) / steps, float(config.fps)]
                body = [self._mesh.mesh.points, self._mesh.mesh.velocities]
                wp.launch(_move_body, dim=len(target), inputs=[*moving, *body])
                self._mesh.mesh.refit()
                self._substep(untangle=step % config.untangle_every == 0)
            positions = self._states[0].particle_q.numpy().copy()
            self.frame += 1
            self._require_calm(positions)
            self.mended = self._mend(positions, target)
        self._positions, self._body = positions, target
        return positions

    def _mend(self, positions: np.ndarray, body: np.ndarray) -> int:
        """Put vertices that are slightly inside the body back outside, here and in the solver; returns how many.

        Where an arm squeezes cloth against the trunk there is no room for the thickness on both sides, and the penalty
        contacts (one a vertex, to the nearest surface) leave a few vertices some millimetres inside either.
        """
        self._closest.refit(body)
        nearest = self._closest.query(positions)
        corners = body[self._body_faces[nearest.face]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        behind = ((positions - nearest.point) * normal).sum(1) < 0
        suspects = np.flatnonzero(behind & (nearest.distance <= self.config.mend_depth))
        if not len(suspects):
            return 0
        self._inside.refit(body)
        within = found = suspects[self._inside(positions[suspects])]
        for _ in range(MENDING_ROUNDS):
            if not len(within):
                break
            nearest = self._closest.query(positions[within])
            out = (nearest.point - positions[within]) / (nearest.distance[:, None] + 1e-9)
            positions[within] = nearest.point + out * self.config.mend_gap
            within = within[self._inside(positions[within])]
        if len(found):
            self._states[0].particle_q.assign(positions)
        return len(found)

    def _substep(self, untangle: bool) -> None:
        """One time step. Its 430 kernel launches are recorded once and replayed: bitwise the same, a fifth faster.

        The body's refit stays outside: Warp 1.19 records launches, but wp.Mesh.refit would silently be skipped.
        """
        self._solver.collision.stiff_ef = UNTANGLING if untangle else 0.0
        if not wp.get_device().is_cpu:
            self._step_once()
        else:
            recorded = (id(self._states[0]), untangle)
            if recorded not in self._substeps:
                with wp.ScopedCapture() as capture:
                    self._step_once()
                self._substeps[recorded] = capture.graph
            wp.capture_launch(self._substeps[recorded])
        self._states.reverse()

    def _step_once(self) -> None:
        now, then = self._states
        now.clear_forces()
        self._pipeline.collide(now, self._contacts)
        self._solver.step(now, then, self._control, self._contacts, 1.0 / self.config.fps / self.config.substeps)

    def calm(self) -> None:
        """Stop all cloth where it is: a step of a quasi-static descent."""
        self._states[0].particle_qd.zero_()

    def _require_calm(self, positions: np.ndarray) -> None:
        speed = np.linalg.norm(positions - self._positions, axis=1) * self.config.fps
        wild = ~(speed <= self.config.fastest)  # NaN is wild too
        if wild.any():
            raise ValueError(
                f"the simulation diverged at frame {self.frame}: {int(wild.sum())} of {len(positions)} vertices "
                f"are NaN or faster than {self.config.fastest:g} m/s; raise substeps or iterations, or soften the cloth"
            )


def require_outside(
    garment: Float[np.ndarray, "N 3"], body_vertices: Float[np.ndarray, "V 3"], body_faces: Int[np.ndarray, "F 3"]
) -> None:
    """Raises ValueError if a garment vertex is inside the body: cloth that starts inside stays inside."""
    within = int(inside(garment, body_vertices, body_faces).sum())
    if within:
        raise ValueError(
            f"{within} of {len(garment)} garment vertices are inside the body at frame 0; "
            "fit the garment to the canonical body (beta = 0, rest pose) first"
        )


def flat_panels(rest: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "M 3"]) -> Float[np.ndarray, "3M 2"]:
    """Each triangle of the rest shape laid flat, three corners in a row: isotropic cloth needs no pattern."""
    a, b, c = (rest[faces[:, corner]] for corner in range(3))
    x = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    flat = np.zeros((len(faces), 3, 2))
    flat[:, 1, 0] = ((b - a) * x).sum(1)
    flat[:, 2, 0] = ((c - a) * x).sum(1)
    flat[:, 2, 1] = ((c - a) * np.cross(normal, x)).sum(1)
    return flat.reshape(-1, 2)


@wp.kernel
def _move_body(
    before: wp.array(dtype=wp.vec3),
    after: wp.array(dtype=wp.vec3),
    share: float,
    fps: float,
    points: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    points[i] = before[i] * (1.0 - share) + after[i] * share
    velocities[i] = (after[i] - before[i]) * fps  # friction acts against the cloth's velocity relative to this
