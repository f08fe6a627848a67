"""Eq. 1 and 18 to look at: Regressor -> the latents of a motion over time beside the canonical garment they give."""

import functools

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from widgets.controls import Button, Choice, Group, shape_sliders
from widgets.panel import Panel, Pixels
from widgets.plot import curves, drawn
from widgets.scene import CLOTH, SKIN, Mesh, Points, Scene, View, camera_of
from workbench.body.model import Body
from workbench.collisions.penetration import Penetration, penetration
from workbench.collisions.regressor import Regressor
from workbench.collisions.subspace import Subspace
from workbench.formats import load_motion, motion_files
from workbench.motion import Motion
from workbench.tryon_demo import SHOWN

FRAMES, EVERY = 30, 2
NAMED = 6  # latents that move most get a colour; the others are grey
SIZE = (620, 440)
AROUND = 1.5  # of the garment's size: what is seen


def regressor_view(
    regressor: Regressor,
    motion: Motion | None = None,
    *,
    subspace: Subspace | None = None,
    frames: int = FRAMES,
    every: int = EVERY,
) -> Panel:
    """Without `motion`, one of the shipped test motions is chosen there; `subspace` is the one that ships.

    The regressor sees every frame; every n-th is decoded, up to `frames` of them.
    """
    body, subspace = Body.default(), subspace or Subspace.shipped(regressor.garment_name)
    garment = subspace.garment
    shipped = {} if motion else {path.stem: path for path in motion_files(None)}
    names = tuple(shipped) or (motion.name if motion and motion.name else "motion",)
    which = Choice("motion", names, SHOWN if SHOWN in names else names[0])
    shape = shape_sliders(regressor.shapes)
    camera = camera_of([Points(garment.vertices.numpy())], margin=AROUND, aspect=SIZE[0] / SIZE[1])
    latents: list[Float[Tensor, "T L"]] = []
    found: list[Penetration] = []

    @functools.cache
    def played(name: str) -> Motion:
        given = motion or load_motion(shipped[name], body)
        if abs(given.fps - regressor.fps) > 1e-3:
            given = given.resampled(regressor.fps)
        return given.clip(0, min(len(given), frames * every))

    @torch.no_grad()
    def scene() -> Scene:
        given = played(which.value)
        latents[:] = [regressor(given.rotations[None], given.translation[None], torch.tensor(shape.value)[None])[0]]
        X = subspace.decode(latents[0][::every])
        found[:] = [penetration(body.template[None], body.faces, X)]
        cloth = Mesh(X.numpy(), garment.faces.numpy(), CLOTH, name="garment", marked=found[0].inside.numpy())
        layers = (Mesh(body.template.numpy(), body.faces.numpy(), SKIN, name="constant body"), cloth)
        return Scene((View(layers, "X = D(R(beta, gamma)), canonical"),), camera, fps=given.fps / every)

    def plot(size: tuple[int, int], frame: int) -> Pixels:
        values = latents[0].numpy()
        return drawn(size, lambda figure: draw_latents(figure, values, regressor.fps, frame * every))

    def readout() -> str:
        moved = latents[0].diff(dim=0).abs().mean() if len(latents[0]) > 1 else torch.zeros(())
        return (
            f"{int(found[0].inside.sum())} of {found[0].inside.numel():,} canonical vertices inside; latents move by "
            f"{float(moved):.3f} a frame, their length is {float(latents[0].norm(dim=-1).mean()):.1f}"
        )

    return Panel(
        (
            Group("Motion", (which,)),
            Group(
                "Shape (standard deviations)",
                (Button("mean shape", lambda: shape.set([0.0] * regressor.shapes)), shape),
            ),
        ),
        scene,
        readout,
        plot=plot,
        title=f"Regressor of {regressor.garment_name!r}",
        size=SIZE,
    )


def draw_latents(figure: Figure, latents: Float[np.ndarray, "T L"], fps: float, frame: int | None) -> None:
    """x_bar over time: those that move most by colour, the others grey."""
    axes = figure.subplots()
    order = np.argsort(-latents.std(axis=0))
    seconds = np.arange(len(latents)) / fps
    for component in order[NAMED:]:
        axes.plot(seconds, latents[:, component], lw=0.6, color="#bbbbbb")
    named = order[:NAMED]
    names = tuple(f"latent {component + 1}" for component in named)
    curves(axes, latents[:, named], fps, names, f"x_bar: the {NAMED} of {latents.shape[1]} that move most", frame)
    axes.legend(fontsize=7, loc="upper right", ncols=2)
    axes.set_xlabel("seconds", fontsize=8)
