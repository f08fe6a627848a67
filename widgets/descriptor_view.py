"""Eq. 17 to look at: Motion -> the moving body beside the curves of gamma."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from widgets.controls import Choice, Group
from widgets.panel import Panel, Pixels
from widgets.plot import curves, drawn
from widgets.scene import SKIN, Mesh, Scene, View
from workbench.body.model import Body
from workbench.collisions.motion_descriptor import POSE_SIZE, PoseDescriptor, descriptor, global_motion
from workbench.collisions.regressor import Regressor
from workbench.motion import Motion

FRAMES = 90  # shown at most
SIZE = (620, 440)
P = POSE_SIZE
POSE_NAMES = tuple(f"{index + 1}" for index in range(P))
ROOT_NAMES, TURN_NAMES = ("aside", "back (the body faces -y)", "up"), ("heading", "about x", "about y")
# Where the parts of gamma lie: title, components, names.
PARTS = {
    "pose": (
        ("theta_bar", slice(0, P), POSE_NAMES),
        ("its velocity (1/s)", slice(P, 2 * P), POSE_NAMES),
        ("its acceleration (1/s²)", slice(2 * P, 3 * P), POSE_NAMES),
    ),
    "root": (
        ("velocity of H (m/s), seen from the body", slice(3 * P, 3 * P + 3), ROOT_NAMES),
        ("acceleration of H (m/s²)", slice(3 * P + 3, 3 * P + 6), ROOT_NAMES),
        ("velocity of K (rad/s)", slice(3 * P + 6, 3 * P + 9), TURN_NAMES),
        ("acceleration of K (rad/s²)", slice(3 * P + 9, 3 * P + 12), TURN_NAMES),
    ),
}


@dataclass(frozen=True, eq=False)
class DescribedMotion:
    """A motion with its descriptor."""

    motion: Motion
    gamma: Float[Tensor, "T D"]

    @staticmethod
    @torch.no_grad()
    def of(motion: Motion, describe: PoseDescriptor) -> "DescribedMotion":
        """gamma of every frame      (Eq. 17)"""
        root = global_motion(motion.rotations[:, 0], motion.translation, motion.fps).stacked()
        return DescribedMotion(motion, descriptor(describe(motion.rotations), root, motion.fps))


def motion_view(
    motion: Motion, regressor: Regressor | None = None, *, body: Body | None = None, frames: int = FRAMES
) -> Panel:
    """The pose descriptor is that of `regressor`, by default the T-shirt's that ships."""
    regressor = regressor or Regressor.shipped("tshirt")
    if abs(motion.fps - regressor.fps) > 1e-3:
        motion = motion.resampled(regressor.fps)
    return described_view(DescribedMotion.of(motion.clip(0, min(frames, len(motion))), regressor.describe), body=body)


def described_view(described: DescribedMotion, *, body: Body | None = None) -> Panel:
    """The body as it moves, in the world, and gamma over time with a cursor at the frame that is seen.

    Errors: ValueError for a motion of another skeleton than the body's.
    """
    body, motion = body or Body.default(), described.motion
    gamma, which = (
        described.gamma.numpy(),
        Choice("curves", tuple(PARTS), told="gamma's 30 of the pose, 12 of the root"),
    )
    vertices = body.vertices(motion.rotations, body.mean_shape(), motion.translation).numpy()
    scene = Scene((View((Mesh(vertices, body.faces.numpy(), SKIN, name="body"),)),), fps=motion.fps)

    def plot(size: tuple[int, int], frame: int) -> Pixels:
        return drawn(size, lambda figure: draw_gamma(figure, gamma, motion.fps, which.value, frame))

    def readout() -> str:
        speed = np.linalg.norm(gamma[:, 3 * P : 3 * P + 2], axis=1)
        return f"{len(motion)} frames at {motion.fps:g} a second; gamma has {gamma.shape[1]} numbers a frame; " + (
            f"the root moves at {speed.mean():.2f} m/s on average over the floor"
        )

    return Panel(
        (Group("Descriptor", (which,)),),
        lambda: scene,
        readout,
        plot=plot,
        title=f"Motion descriptor: {motion.name or 'motion'}",
        size=SIZE,
    )


def draw_gamma(figure: Figure, gamma: Float[np.ndarray, "T D"], fps: float, which: str, frame: int | None) -> None:
    """Part of gamma, one axis a quantity."""
    parts = PARTS[which]
    named: tuple[str, ...] = POSE_NAMES  # ten alike need no legend
    for axes, (title, components, names) in zip(figure.subplots(len(parts), 1, sharex=True), parts, strict=True):
        curves(axes, gamma[:, components], fps, names, title, frame)
        if names != named:
            named = names
            axes.legend(fontsize=7, loc="upper right", ncols=3)
    figure.axes[-1].set_xlabel("seconds", fontsize=8)
