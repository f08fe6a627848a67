"""Eq. 4-6 to look at: DiffusedFields -> cuts through space: one joint's weight, the heaviest joint, B~s, B~p.

Several implementations (Monte Carlo, networks, table) are shown side by side on one cut.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from widgets.body_view import HEAVIEST, WEIGHTS, heaviest_joint
from widgets.controls import Choice, Group, shape_sliders, theta_sliders
from widgets.panel import Panel, size_for
from widgets.scene import SKIN, Mesh, Scalars, Scene, View
from widgets.slice_plane import SliceControls, SlicePlane, tensor_of
from workbench.body.model import Body
from workbench.collisions.diffused_body import DiffusedFields, GridFields, LearnedFields, MonteCarloFields
from workbench.geometry.rotations import axis_angle_to_matrix

MILLI = 1e3
SHAPE, POSE, DIFFERENCE = "shape offset B~s (mm)", "pose offset B~p (mm)", "weights: apart from the first (L1)"
LEAST_OFFSET = 1.0  # millimetres at the end of the colour map, at least
APART = (0.0, 0.5)
FIRST_BETA, FIRST_THETA = (2.0, -1.0), (0.0, -90.0, 0.0)
GHOST = 0.25
POINTS = {MonteCarloFields: 40, LearnedFields: 80, GridFields: 120}  # on the longer side of a cut: a second at most
COARSEST = 40
NAMES = {MonteCarloFields: "Monte Carlo", LearnedFields: "networks", GridFields: "table"}


def fields_view(
    fields: DiffusedFields,
    *others: DiffusedFields,
    body: Body | None = None,
    names: tuple[str, ...] = (),
    joint: str | None = None,
    across: int | None = None,
) -> Panel:
    """`others` are shown beside it; `across` are the points on the longer side of a cut (by default as many as the
    slowest of them does in about a second).

    `body` is the one the fields were made for, by default the default body.
    """
    shown, body = (fields, *others), body or Body.default()
    names = names or _names(shown)
    if len(names) != len(shown):
        raise ValueError(f"{len(names)} names for {len(shown)} implementations of the fields")
    across = across or min(POINTS.get(type(one), COARSEST) for one in shown)
    cut = SliceControls.around(body.template)
    quantities = (WEIGHTS, HEAVIEST, SHAPE, POSE, *((DIFFERENCE,) if others else ()))
    quantity = Choice("quantity", quantities)
    which = Choice("joint", body.joint_names, joint or _arm(body))
    shape, turn = shape_sliders(body.shape_count, FIRST_BETA), theta_sliders(FIRST_THETA)
    ghost = Mesh(body.template.numpy(), body.faces.numpy(), SKIN, GHOST, name="body")
    seen, size = Cut(shown, body), size_for(len(shown))

    def scene() -> Scene:
        plane = cut.plane(across)
        angles = torch.zeros(len(body.joint_names), 3)
        angles[body.joint_names.index(which.value)] = torch.deg2rad(torch.tensor(turn.value))
        if quantity.value == SHAPE:
            values = _lengths("|B~s|", seen.shape(plane, torch.tensor(shape.value)))
        elif quantity.value == POSE:
            values = _lengths("|B~p|", seen.pose(plane, axis_angle_to_matrix(angles)))
        else:
            values = [_of_weights(quantity.value, seen, i, plane, body, which.value) for i in range(len(shown))]
        views = tuple(View((ghost, plane.coloured(v)), name) for v, name in zip(values, names, strict=True))
        return Scene(views, cut.camera(size[0] / len(shown) / size[1]))

    def readout() -> str:
        plane, parts = cut.plane(across), []
        first = seen.weights(0, plane)
        for index, name in enumerate(names[1:], start=1):
            apart = (seen.weights(index, plane) - first).abs().sum(-1)
            parts.append(f"W~ of {name} is {float(apart.mean()):.3f} (L1, mean over the cut) from {names[0]}'s")
        where = f"cut at {'xyz'[cut.axis]} = {cut.position:.2f} m, {len(plane.points):,} points"
        return "; ".join([where, *parts])

    return Panel(
        (
            Group("What is seen", (quantity, which)),
            cut.group,
            Group("Shape, for B~s", (shape,), folded=True),
            Group("Turn of the joint, for B~p", (turn,), folded=True),
        ),
        scene,
        readout,
        title="Diffused body",
        size=size,
    )


class Cut:
    """Fields on the last cut, kept: another joint, beta or theta costs no new query of W~."""

    def __init__(self, shown: tuple[DiffusedFields, ...], body: Body):
        self.shown, self.body = shown, body
        self.plane: SlicePlane | None = None
        self.kept: dict[int, Float[Tensor, "N J"]] = {}

    @torch.no_grad()
    def weights(self, index: int, plane: SlicePlane) -> Float[Tensor, "N J"]:
        """W~      (Eq. 4)"""
        if self.plane is None or not np.array_equal(self.plane.points, plane.points):
            self.plane, self.kept = plane, {}
        if index not in self.kept:
            self.kept[index] = self.shown[index].weights(tensor_of(plane))
        return self.kept[index]

    @torch.no_grad()
    def shape(self, plane: SlicePlane, betas: Float[Tensor, "K"]) -> list[Float[Tensor, "N 3"]]:
        """B~s of every implementation      (Eq. 5)"""
        return [one.shape_offsets(tensor_of(plane), betas) for one in self.shown]

    @torch.no_grad()
    def pose(self, plane: SlicePlane, rotations: Float[Tensor, "J 3 3"]) -> list[Float[Tensor, "N 3"]]:
        """B~p of every implementation      (Eq. 6)"""
        return [one.pose_offsets(tensor_of(plane), self.body.pose_feature(rotations)) for one in self.shown]


def _lengths(name: str, offsets: list[Float[Tensor, "N 3"]]) -> list[Scalars]:
    """Millimetres, one colour map for all."""
    lengths = [MILLI * moved.norm(dim=-1).numpy() for moved in offsets]
    most = max(LEAST_OFFSET, *(float(np.quantile(length, 0.99)) for length in lengths))
    return [Scalars(length, name, "mm", (0.0, most), "magma") for length in lengths]


def _of_weights(quantity: str, seen: Cut, index: int, plane: SlicePlane, body: Body, joint: str) -> Scalars:
    weights = seen.weights(index, plane)
    if quantity == WEIGHTS:
        values = weights[:, body.joint_names.index(joint)].numpy()
        return Scalars(values, f"weight of {joint}", limits=(0.0, 1.0), colour_map="YlOrRd")
    if quantity == HEAVIEST:
        return heaviest_joint(weights, body.joint_names)
    apart = (weights - seen.weights(0, plane)).abs().sum(-1)
    return Scalars(apart.numpy(), "apart", "L1", APART, "magma")


def _names(shown: tuple[DiffusedFields, ...]) -> tuple[str, ...]:
    words = [NAMES.get(type(one), type(one).__name__) for one in shown]
    samples = [f" ({len(one.directions)} samples)" if isinstance(one, MonteCarloFields) else "" for one in shown]
    return tuple(word + more for word, more in zip(words, samples, strict=True))


def _arm(body: Body) -> str:
    """The upper arm where there is one under a known name, else the last joint."""
    for name in ("LeftArm", "left_shoulder"):
        if name in body.joint_names:
            return name
    return body.joint_names[-1]
