"""Eq. 2-3 to look at: Body -> beta, theta of a joint, weights by colour; linear blending beside dual quaternions."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from widgets.controls import Button, Choice, Group, shape_sliders, theta_sliders
from widgets.panel import Panel
from widgets.scene import SKIN, Mesh, Scalars, Scene, View
from workbench.body.model import Body
from workbench.geometry.rotations import axis_angle_to_matrix

MILLI = 1e3
WEIGHTS, HEAVIEST, APART, PLAIN = "weights of the joint", "heaviest joint", "linear - dual (mm)", "plain"
TWIST = 120.0  # degrees: where linear blending visibly loses volume
FARTHEST = 30.0  # millimetres at the end of the colour map


def body_view(body: Body, *, joint: str | None = None, theta: Sequence[float | int] | None = None) -> Panel:
    """`joint` is the one that `theta` (a rotation vector, degrees) turns, by default a forearm that is twisted.

    Errors: ValueError for a joint that the body does not have.
    """
    which = Choice("joint", body.joint_names, joint or _twisted_joint(body), "the joint that theta turns")
    start = theta or tuple(TWIST * float(part) for part in _bone_direction(body, which.value))
    shape, turn = shape_sliders(body.shape_count), theta_sliders(start)
    colour = Choice("colour", (WEIGHTS, HEAVIEST, APART, PLAIN))
    turned: dict[str, tuple[float, ...]] = {which.value: turn.value}

    def take_joint() -> None:
        turn.set(turned.get(which.value, (0.0, 0.0, 0.0)))

    def keep_turn() -> None:
        turned[which.value] = turn.value

    def rest() -> None:
        with panel.held():
            turned.clear()
            turn.set((0.0, 0.0, 0.0))

    def mean() -> None:
        shape.set([0.0] * body.shape_count)

    which.listen(take_joint)
    turn.listen(keep_turn)

    def rotations() -> Float[Tensor, "J 3 3"]:
        angles = torch.zeros(len(body.joint_names), 3)
        for name, degrees in turned.items():
            angles[body.joint_names.index(name)] = torch.deg2rad(torch.tensor(degrees))
        return axis_angle_to_matrix(angles)

    def scene() -> Scene:
        betas, faces = torch.tensor(shape.value), body.faces.numpy()
        linear = body.vertices(rotations(), betas)
        dual = body.vertices(rotations(), betas, skinning="dual_quaternion")
        values = _colours(body, colour.value, which.value, linear, dual)
        return Scene(
            (
                View((Mesh(linear.numpy(), faces, SKIN, scalars=values, name="body, linear"),), "linear blending"),
                View((Mesh(dual.numpy(), faces, SKIN, scalars=values, name="body, dual"),), "dual quaternions"),
            )
        )

    def readout() -> str:
        betas = torch.tensor(shape.value)
        linear = body.vertices(rotations(), betas)
        apart = MILLI * (linear - body.vertices(rotations(), betas, skinning="dual_quaternion")).norm(dim=-1)
        height = float(linear[:, 2].max() - linear[:, 2].min())
        return (
            f"from head to sole {height:.2f} m; the two skinnings are {float(apart.mean()):.1f} mm apart on average, "
            f"{float(apart.max()):.0f} mm at most"
        )

    panel = Panel(
        (
            Group("Pose", (Button("rest pose", rest, "theta = 0 for every joint"), which, turn)),
            Group("Look", (colour,)),
            Group("Shape (standard deviations)", (Button("mean shape", mean, "beta = 0"), shape)),
        ),
        scene,
        readout,
        title=f"Body {body.name!r}",
    )
    return panel


def joint_weights(body: Body, joint: str) -> Scalars:
    """One joint's skinning weight at every vertex."""
    values = body.weights[:, body.joint_names.index(joint)].numpy()
    return Scalars(values, f"weight of {joint}", limits=(0.0, 1.0), colour_map="YlOrRd")


def heaviest_joint(weights: Float[Tensor, "N J"], names: tuple[str, ...]) -> Scalars:
    """Which joint moves each point most."""
    return Scalars(weights.argmax(dim=-1).numpy().astype(np.float32), "heaviest joint", categories=names)


def _colours(
    body: Body, colour: str, joint: str, linear: Float[Tensor, "V 3"], dual: Float[Tensor, "V 3"]
) -> Scalars | None:
    if colour == WEIGHTS:
        return joint_weights(body, joint)
    if colour == HEAVIEST:
        return heaviest_joint(body.weights, body.joint_names)
    if colour == APART:
        apart = MILLI * (linear - dual).norm(dim=-1).numpy()
        return Scalars(apart, "apart", "mm", (0.0, FARTHEST), "magma")
    return None


def _twisted_joint(body: Body) -> str:
    """A forearm where there is one under a known name, else the last joint but one."""
    for name in ("LeftForeArm", "left_elbow"):
        if name in body.joint_names:
            return name
    return body.joint_names[-2]


def _bone_direction(body: Body, joint: str) -> Float[np.ndarray, "3"]:
    """Along the bone that leaves the joint; up where none does."""
    index = body.joint_names.index(joint)
    if index not in body.parents:
        return np.array([0.0, 0.0, 1.0])
    bone = (body.joint_template[body.parents.index(index)] - body.joint_template[index]).numpy()
    return bone / np.linalg.norm(bone)
