"""Fig. 3 to look at: a simulated garment, and what constant weights, nearest weights and Eq. 9 make of it.

Objects: `ProjectionComparison.of(projector, sequence)`, or the Projector itself; a SimulatedSequence alone is played.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from widgets.demo_picture import standing_place
from widgets.panel import Panel
from widgets.scene import CLOTH, SKIN, Mesh, Points, Scalars, Scene, View, camera_of, dressed
from workbench.body.model import Body
from workbench.collisions.penetration import penetration
from workbench.collisions.projection import Projection, Projector
from workbench.collisions.projection_baselines import constant_weights, nearest_weights
from workbench.collisions.sequences import SimulatedSequence, shipped_sequence

MILLI = 1e3
FRAMES = 8  # projected for a view: a few seconds
ERROR = (0.0, 2.0)  # millimetres at the ends of the colour map
SIZE = (1080, 460)
AROUND = 1.25  # of the garments' size: what is seen
SHIPPED = "tshirt_walk"


@dataclass(frozen=True, eq=False)
class ProjectionComparison:
    """Frames of a simulation and three ways of taking pose and shape off them (Fig. 3)."""

    simulated: Float[Tensor, "T N 3"]
    bodies: Float[Tensor, "T V 3"]
    constant: Float[Tensor, "T N 3"]  # Fig. 3 b
    nearest: Float[Tensor, "T N 3"]  # Fig. 3 c
    ours: Projection  # Fig. 3 d
    body: Body
    faces: Int[Tensor, "F 3"]
    fps: float

    @staticmethod
    def of(
        projector: Projector, sequence: SimulatedSequence, frames: int = FRAMES, start: int = 0, every: int = 1
    ) -> "ProjectionComparison":
        """Every n-th kept frame of a sequence, from `start` on.

        Errors: ValueError when nothing is left, or as `Projector.project`'s.
        """
        kept = sequence.valid.nonzero()[:, 0][start : start + frames * every : every]
        if not len(kept):
            raise ValueError(
                f"sequence {sequence.motion_name!r} has {int(sequence.valid.sum())} kept frames; none from {start} on"
            )
        garment, body = sequence.garment[kept], projector.model.body
        state = projector.model.state(sequence.rotations[kept], sequence.betas, sequence.translation[kept])
        bodies = body.vertices(sequence.rotations[kept], sequence.betas, sequence.translation[kept])
        return ProjectionComparison(
            garment,
            bodies,
            constant_weights(body, projector.template, garment, state),
            nearest_weights(body, garment, state, bodies),
            projector.project(garment, state),
            body,
            sequence.faces,
            sequence.fps / every,
        )


def jitter(X: Float[Tensor, "T N 3"]) -> float:
    """Mean second difference from frame to frame, millimetres; 0 for fewer than three frames."""
    if len(X) < 3:
        return 0.0
    return MILLI * float((X[2:] - 2 * X[1:-1] + X[:-2]).norm(dim=-1).mean())


def comparison_view(shown: ProjectionComparison) -> Panel:
    """Four linked views over time: Fig. 3 a-d; what lies inside the constant body is marked."""
    body_faces, faces = shown.body.faces.numpy(), shown.faces.numpy()
    here = np.stack([standing_place(body) for body in shown.bodies.numpy()])[:, None]
    here[..., 2] = 0.0
    inside = penetration(shown.bodies, shown.body.faces, shown.simulated).inside
    error = Scalars(MILLI * shown.ours.error.numpy(), "re-posing error", "mm", ERROR, "magma")
    views = [
        View(
            (
                Mesh(shown.bodies.numpy() - here, body_faces, SKIN, name="body"),
                Mesh(shown.simulated.numpy() - here, faces, CLOTH, name="garment", marked=inside.numpy()),
            ),
            f"a) simulated: {_share(inside)} inside",
        )
    ]
    told = []
    constant_body = shown.body.template
    cloths = [shown.simulated.numpy() - here]
    for title, X, choices in (
        ("b) constant weights", shown.constant, ()),
        ("c) nearest weights", shown.nearest, ()),
        ("d) ours (Eq. 9)", shown.ours.canonical, (error,)),
    ):
        within = penetration(constant_body[None], shown.body.faces, X).inside
        cloth = Mesh(X.numpy(), faces, CLOTH, name="garment", marked=within.numpy(), choices=choices)
        layers = (Mesh(constant_body.numpy(), body_faces, SKIN, name="constant body"), cloth)
        views.append(View(layers, f"{title}: {_share(within)} inside"))
        cloths.append(X.numpy())
        told.append(f"{title[3:]} {_share(within)} inside, jitter {jitter(X):.2f} mm")
    camera = camera_of([Points(cloth) for cloth in cloths], margin=AROUND, aspect=SIZE[0] / len(views) / SIZE[1])
    scene = Scene(tuple(views), camera, fps=shown.fps)
    worst = MILLI * float(shown.ours.error.max())
    readout = (
        f"{len(shown.simulated)} frames; {'; '.join(told)}; ours comes back within "
        f"{MILLI * float(shown.ours.error.mean()):.3f} mm on average, {worst:.1f} mm at worst"
    )
    return Panel((), lambda: scene, lambda: readout, title="Projection (Fig. 3)", size=SIZE)


def projector_view(
    projector: Projector,
    sequence: SimulatedSequence | None = None,
    *,
    frames: int = FRAMES,
    start: int = 30,
    every: int = 1,
) -> Panel:
    """Projects some frames of a simulation, by default of a shipped walk, and shows them as `ProjectionComparison`."""
    given = shipped_sequence(SHIPPED) if sequence is None else sequence
    return comparison_view(ProjectionComparison.of(projector, given, frames, start, every))


def sequence_view(sequence: SimulatedSequence, body: Body | None = None) -> Panel:
    """A simulation as it is, on its body; `body` is the one it was simulated on, by default the default body."""
    body = body or Body.default()
    bodies = body.vertices(sequence.rotations, sequence.betas, sequence.translation)
    inside = penetration(bodies, body.faces, sequence.garment).inside
    shown = dressed(
        bodies.numpy(), body.faces.numpy(), sequence.garment.numpy(), sequence.faces.numpy(), colliding=inside.numpy()
    )
    scene = Scene((shown,), fps=sequence.fps)
    readout = f"{len(sequence)} frames, {int(sequence.valid.sum())} kept; {_share(inside)} of the vertices inside"
    return Panel((), lambda: scene, lambda: readout, title=f"{sequence.garment_name}, {sequence.motion_name}")


def _share(inside: Bool[Tensor, "T N"]) -> str:
    return f"{100 * float(inside.float().mean()):.2f} %"
