"""Eq. 13-16 to look at: Subspace -> 25 latent sliders, what they decode to, and what of it is inside the body.

Two subspaces, such as one with and one without the self-supervised term of Eq. 16, are shown side by side.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from widgets.controls import Button, Group, Number, latent_sliders, seed_slider
from widgets.panel import Panel, size_for
from widgets.scene import CLOTH, SKIN, Mesh, Points, Scalars, Scene, View, camera_of
from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF, GridSDF
from workbench.collisions.subspace import LATENTS, Subspace
from workbench.geometry.layer_count import LayerCount

MILLI = 1e3
AROUND = 1.5  # of the garment's size: what is seen
GAP = (0.0, 60.0)  # millimetres at the ends of the colour map


@dataclass(frozen=True, eq=False)
class Decoded:
    """A latent decoded, and how it lies to the constant body: all that is shown of one subspace."""

    garment: Float[Tensor, "N 3"]
    distance: Float[Tensor, "N"]  # SDF of Eq. 12, metres
    inside: Bool[Tensor, "N"]  # by exact winding number

    @property
    def told(self) -> str:
        """The count, in words."""
        return f"{int(self.inside.sum())} of {len(self.inside):,} inside"


@torch.no_grad()
def decoded(subspace: Subspace, latent: Float[Tensor, "L"], sdf: BodySDF, layers: LayerCount) -> Decoded:
    """D(x_bar), its distance by the SDF, its colliding vertices by winding number."""
    X = subspace.decode(latent)
    return Decoded(X, sdf(X), torch.from_numpy(layers(X.numpy()) >= 1))


def subspace_view(subspace: Subspace, *others: Subspace, names: tuple[str, ...] = ()) -> Panel:
    """`others` of the same garment are decoded from the same latent; `names` are their titles, the first one's too.

    Errors: ValueError for subspaces of different garments, or as many names as there are not subspaces.
    """
    shown = (subspace, *others)
    names = names or _names(shown)
    if len(names) != len(shown):
        raise ValueError(f"{len(names)} names for {len(shown)} subspaces")
    if len({one.vertex_count for one in shown}) > 1:
        counts = ", ".join(f"{one.garment_name!r} {one.vertex_count}" for one in shown)
        raise ValueError(f"the subspaces are of different garments ({counts} vertices); show each alone")
    garment, body = subspace.garment, Body.default()
    sdf, layers = GridSDF.default(), LayerCount(body.template.numpy(), body.faces.numpy())
    body_mesh, faces = body.template.numpy(), body.faces.numpy()

    latent, seed = latent_sliders(LATENTS), seed_slider()
    between = Number("A to B", 0.0, 0.0, 1.0, 0.02, "the straight way between two latents")
    ends = {"A": latent.value, "B": _random(1)}
    now: list[Decoded] = []
    size = size_for(len(shown))
    aspect = size[0] / len(shown) / size[1]
    camera = camera_of([Points(garment.vertices.numpy())], margin=AROUND, aspect=aspect)

    def scene() -> Scene:
        now[:] = [decoded(one, torch.tensor(latent.value), sdf, layers) for one in shown]
        views = []
        for name, result in zip(names, now, strict=True):
            gap = Scalars(MILLI * result.distance.numpy(), "gap to the body", "mm", GAP, "cividis")
            cloth = Mesh(
                result.garment.numpy(),
                garment.faces.numpy(),
                CLOTH,
                name="garment",
                marked=result.inside.numpy(),
                choices=(gap,),
            )
            views.append(View((Mesh(body_mesh, faces, SKIN, name="constant body"), cloth), f"{name}: {result.told}"))
        return Scene(tuple(views), camera)

    def readout() -> str:
        parts = []
        for name, result in zip(names, now, strict=True):
            by_table, gap = int((result.distance < 0).sum()), MILLI * float(result.distance.mean())
            parts.append(
                f"{name}: {result.told} by exact winding number, {by_table} by the SDF's sign; "
                f"mean gap {gap:.0f} mm; |latent| {np.linalg.norm(latent.value):.1f}"
            )
        return " | ".join(parts)

    def random() -> None:
        with panel.held():
            seed.set((seed.value + 1) % (int(seed.high) + 1))
            latent.set(_random(seed.value))

    def keep(end: str) -> None:
        ends[end] = latent.value

    def go_between() -> None:
        t = between.value
        latent.set([(1 - t) * a + t * b for a, b in zip(ends["A"], ends["B"], strict=True)])

    seed.listen(lambda: latent.set(_random(seed.value)))
    between.listen(go_between)
    panel = Panel(
        (
            Group(
                "Garments from N(0, I)",
                (
                    Button("random", random, "25 numbers from the normal distribution"),
                    Button("reset", latent.reset, "the mean garment: all latents 0"),
                    seed,
                ),
            ),
            Group(
                "From one garment to another",
                (
                    Button("keep as A", lambda: keep("A"), "the present garment is where the way starts"),
                    Button("keep as B", lambda: keep("B"), "the present garment is where the way ends"),
                    between,
                ),
            ),
            Group("Latents (standard deviations)", (latent,)),
        ),
        scene,
        readout,
        title=f"Subspace of {subspace.garment_name!r}",
        size=size,
    )
    return panel


def _random(seed: int) -> tuple[float, ...]:
    """A latent of N(0, I)."""
    numbers = torch.randn(LATENTS, generator=torch.Generator().manual_seed(seed))
    return tuple(round(float(number), 3) for number in numbers)


def _names(shown: tuple[Subspace, ...]) -> tuple[str, ...]:
    """What sets each apart: whether the self-supervised term trained it."""
    if len(shown) == 1:
        return (shown[0].garment_name,)
    words = []
    for index, one in enumerate(shown):
        weights = one.story.get("config", {}).get("weights", {})
        told = {True: "with self-supervision", False: "without self-supervision"}.get(weights.get("self_supervised"))
        words.append(told or f"{one.garment_name} {index + 1}")
    if len(set(words)) < len(words):
        return tuple(f"{word} ({index + 1})" for index, word in enumerate(words))
    return tuple(words)
