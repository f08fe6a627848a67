"""Eq. 7-8 to look at: GarmentModel -> a canonical garment, deformed (Eq. 8), posed (Eq. 7), as beta and theta move."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from widgets.controls import Button, Choice, Group, shape_sliders, theta_sliders
from widgets.panel import Panel, size_for
from widgets.scene import CLOTH, SKIN, Mesh, Scene, View
from workbench.collisions.garment_model import GarmentModel
from workbench.garments import Garment
from workbench.geometry.layer_count import LayerCount
from workbench.geometry.rotations import axis_angle_to_matrix

FIRST_BETA = (1.0, 1.5, 0.0, -1.0)
FIRST_TURN = {"LeftArm": (0.0, -45.0, 0.0), "left_shoulder": (0.0, -45.0, 0.0)}  # an arm is raised


def garment_model_view(
    model: GarmentModel,
    garment: Garment | None = None,
    *,
    canonical: Float[Tensor, "N 3"] | None = None,
    rotations: Float[Tensor, "J 3 3"] | None = None,
    betas: Sequence[float | int] | Float[Tensor, "K"] | None = None,
) -> Panel:
    """`garment` is the T-shirt's template unless given; `canonical` are other positions X of its vertices.

    `rotations` and `betas` are where the controls start: theta turns the chosen joint on top of `rotations`.
    """
    garment = garment or Garment.load("tshirt")
    body, X = model.body, garment.vertices if canonical is None else canonical
    faces, body_faces = garment.faces.numpy(), body.faces.numpy()
    base = body.rest_rotations() if rotations is None else rotations
    start = FIRST_BETA if betas is None else tuple(float(number) for number in betas)
    shape = shape_sliders(body.shape_count, start)
    first = next((name for name in FIRST_TURN if name in body.joint_names), body.joint_names[-1])
    which = Choice("joint", body.joint_names, first, "the joint that theta turns")
    turn = theta_sliders(FIRST_TURN.get(first, (0.0, 0.0, 0.0)) if rotations is None else (0.0, 0.0, 0.0))
    turned: dict[str, tuple[float, ...]] = {first: turn.value}
    layers = LayerCount(body.template.numpy(), body_faces)
    counts: list[int] = []

    def theta() -> Float[Tensor, "J 3 3"]:
        angles = torch.zeros(len(body.joint_names), 3)
        for name, degrees in turned.items():
            angles[body.joint_names.index(name)] = torch.deg2rad(torch.tensor(degrees))
        return base @ axis_angle_to_matrix(angles)

    @torch.no_grad()
    def scene() -> Scene:
        beta, now = torch.tensor(shape.value), theta()
        state = model.state(now, beta)
        stages = (
            ("X, canonical", X, body.template),
            ("T_G = X + B~s + B~p", model.unposed(X, state), body.unposed(now, beta)),
            ("M_G, posed", model.posed(X, state), body.vertices(now, beta)),
        )
        counts.clear()
        views = []
        for title, cloth, surface in stages:
            inside = _inside(layers, surface, cloth)
            counts.append(int(inside.sum()))
            views.append(
                View(
                    (
                        Mesh(surface.numpy(), body_faces, SKIN, name="body"),
                        Mesh(cloth.numpy(), faces, CLOTH, name="garment", marked=inside),
                    ),
                    f"{title}: {counts[-1]} inside",
                )
            )
        return Scene(tuple(views))

    def readout() -> str:
        return (
            f"vertices inside the body: {counts[0]} canonical, {counts[1]} deformed, {counts[2]} posed, of {len(X):,} "
            "(exact winding number)"
        )

    def take_joint() -> None:
        turn.set(turned.get(which.value, (0.0, 0.0, 0.0)))

    def keep_turn() -> None:
        turned[which.value] = turn.value

    def rest() -> None:
        with panel.held():
            turned.clear()
            turn.set((0.0, 0.0, 0.0))

    which.listen(take_joint)
    turn.listen(keep_turn)
    panel = Panel(
        (
            Group("Pose", (Button("undo all turns", rest), which, turn)),
            Group(
                "Shape (standard deviations)",
                (Button("mean shape", lambda: shape.set([0.0] * body.shape_count)), shape),
            ),
        ),
        scene,
        readout,
        title=f"Garment model, {garment.name!r}",
        size=size_for(3),
    )
    return panel


def _inside(layers: LayerCount, body: Float[Tensor, "V 3"], garment: Float[Tensor, "N 3"]) -> Bool[np.ndarray, "N"]:
    """By exact winding number."""
    layers.refit(body.numpy())
    return layers(garment.numpy()) >= 1
