"""Try-on to look at: the dressed body in motion beside the canonical garment it comes from; shape sliders.

`workbench demo`'s picture and page are drawn here, too.
"""

import functools
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from widgets.controls import Button, Choice, Group, Toggle, shape_sliders
from widgets.demo_picture import standing_place
from widgets.frontend_bundle import NotBundled
from widgets.gl import CannotDraw
from widgets.page import write_page
from widgets.panel import Panel
from widgets.picture import write_picture
from widgets.scene import CLOTH, SKIN, Mesh, Scene, View, dressed
from workbench.body.model import Body
from workbench.collisions.frame_posing import frame_poser
from workbench.collisions.penetration import Penetration, penetration
from workbench.collisions.tryon import TryOn, TryOnResult, checked_shape
from workbench.formats import load_motion, motion_files
from workbench.motion import Motion
from workbench.tryon_demo import SHOWN, TryOnDemo

log = logging.getLogger(__name__)

COLUMNS = 4  # frames in the picture
SECONDS_SHOWN = 2
VIEW = (380, 560)  # pixels of one view: a body is higher than wide


def draw_tryon(demo: TryOnDemo, path: Path) -> Path:
    """Frames of the motion over the canonical garments they come from; left out where a machine cannot draw."""
    scene = strip(demo)
    try:
        return write_picture(path, scene, (VIEW[0] * scene.columns, 2 * VIEW[1]))
    except CannotDraw as reason:
        log.warning("%s is left out: %s", path.name, reason)
        return path


def write_tryon_page(demo: TryOnDemo, path: Path) -> Path:
    """The motion as one offline HTML file; left out where the viewer was not bundled."""
    share = 100 * demo.posed.share
    try:
        return write_page(path, moving(demo), f"Try-on: {len(demo.result.garment)} frames, {share:.3f} % inside")
    except NotBundled as reason:
        log.warning("%s is left out: %s", path.name, reason)
        return path


def strip(demo: TryOnDemo, columns: int = COLUMNS) -> Scene:
    """The first row posed, the second canonical; colliding vertices are drawn on top."""
    result, T = demo.result, len(demo.result.garment)
    frames = sorted({round(step) for step in np.linspace(0, T - 1, min(columns, T) * 2 + 1)[1::2]})
    above, below = [], []
    for frame in frames:
        body = result.body[frame].numpy()
        here = standing_place(body)
        inside, within = demo.posed.inside[frame].numpy(), demo.canonical.inside[frame].numpy()
        faces = result.body_faces.numpy(), result.garment_faces.numpy()
        above.append(
            dressed(
                body - here,
                faces[0],
                result.garment[frame].numpy() - here,
                faces[1],
                colliding=inside,
                title=f"frame {frame}: {int(inside.sum())} inside",
            )
        )
        below.append(
            dressed(
                demo.constant_body.numpy(),
                faces[0],
                result.canonical[frame].numpy(),
                faces[1],
                colliding=within,
                title=f"canonical: {int(within.sum())} inside",
            )
        )
    return Scene((*above, *below), columns=len(frames))


def moving(demo: TryOnDemo) -> Scene:
    """Posed and canonical side by side, over time; vertices inside the body are marked."""
    return moving_scene(demo.result, demo.posed.inside, demo.canonical.inside, demo.constant_body)


def moving_scene(
    result: TryOnResult,
    posed_inside: Bool[Tensor, "T N"],
    canonical_inside: Bool[Tensor, "T N"],
    constant_body: Float[Tensor, "V 3"],
) -> Scene:
    """The posed garment where the body stands still, and the canonical one; what lies inside the body is marked."""
    here = np.stack([standing_place(body) for body in result.body.numpy()])[:, None]
    here[..., 2] = 0.0
    body_faces, garment_faces = result.body_faces.numpy(), result.garment_faces.numpy()
    posed = View(
        (
            Mesh(result.body.numpy() - here, body_faces, SKIN, name="body"),
            Mesh(result.garment.numpy() - here, garment_faces, CLOTH, name="garment", marked=posed_inside.numpy()),
        ),
        "posed",
    )
    canonical = View(
        (
            Mesh(constant_body.numpy(), body_faces, SKIN, name="constant body"),
            Mesh(
                result.canonical.numpy(),
                garment_faces,
                CLOTH,
                name="canonical garment",
                marked=canonical_inside.numpy(),
            ),
        ),
        "canonical",
    )
    return Scene((posed, canonical), columns=2, fps=result.motion.fps)


def demo_view(demo: TryOnDemo) -> Panel:
    """What `workbench demo` made."""
    scene = moving(demo)
    return Panel((), lambda: scene, lambda: told(demo.posed, demo.canonical), title="Try-on")


def result_view(result: TryOnResult, *, constant_body: Float[Tensor, "V 3"] | None = None) -> Panel:
    """A dressed motion as it is, its collisions counted by exact winding number.

    `constant_body` is the canonical one, by default the default body's.
    """
    constant = Body.default().template if constant_body is None else constant_body
    posed = penetration(result.body, result.body_faces, result.garment)
    canonical = penetration(constant[None], result.body_faces, result.canonical)
    scene = moving_scene(result, posed.inside, canonical.inside, constant)
    return Panel((), lambda: scene, lambda: told(posed, canonical), title=f"Try-on: {result.motion.name}")


def tryon_view(
    tryon: TryOn, motion: Motion | None = None, *, frames: int = SECONDS_SHOWN * 15, every: int = 2
) -> Panel:
    """Shape sliders while a motion plays; without `motion`, one of the test motions that ship is chosen there.

    Every `every`-th frame is posed and counted, up to `frames` of them: that bounds how long a slider takes.
    """
    body = tryon.model.body
    shape = shape_sliders(body.shape_count, (0.8, -1.0, -1.2, 0.6))
    clear = Toggle("clear limbs off the body", True, "cloth cannot be where the body overlaps itself")
    shipped = {} if motion else {path.stem: path for path in motion_files(None)}
    names = tuple(shipped) or (motion.name if motion and motion.name else "motion",)
    which = Choice("motion", names, SHOWN if SHOWN in names else names[0])
    found: list[Penetration] = []

    @functools.cache
    def played(name: str, cleared: bool) -> Motion:
        given = motion or load_motion(shipped[name], body)
        if abs(given.fps - tryon.regressor.fps) > 1e-3:
            given = given.resampled(tryon.regressor.fps)
        given = given.clip(0, min(len(given), frames * every))
        return given.cleared(body) if cleared else given

    def scene() -> Scene:
        result = dressed_frames(tryon, played(which.value, clear.value), torch.tensor(shape.value), every)
        found[:] = (
            penetration(result.body, body.faces, result.garment),
            penetration(body.template[None], body.faces, result.canonical),
        )
        return moving_scene(result, found[0].inside, found[1].inside, body.template)

    return Panel(
        (
            Group("Motion", (which, clear)),
            Group(
                "Shape (standard deviations)",
                (Button("mean shape", lambda: shape.set([0.0] * body.shape_count)), shape),
            ),
        ),
        scene,
        lambda: told(*found),
        title=f"Try-on of {tryon.garment.name!r}",
    )


@torch.no_grad()
def dressed_frames(tryon: TryOn, motion: Motion, betas: Float[Tensor, "K"], every: int = 1) -> TryOnResult:
    """`tryon.run`, of which only every n-th frame is decoded and posed; the regressor sees all of them."""
    betas = checked_shape(betas, tryon.model.body)
    latent = tryon.latents(motion, betas)[::every]
    thin = replace(
        motion,
        rotations=motion.rotations[::every],
        translation=motion.translation[::every],
        fps=motion.fps / every,
    )
    canonical = tryon.shaped(latent, thin.rotations, betas)
    pose = frame_poser(tryon.model, betas, canonical.shape[1])
    frames = zip(canonical, thin.rotations, thin.translation, strict=True)
    return TryOnResult(
        latent=latent,
        canonical=canonical,
        garment=torch.stack([pose(*frame) for frame in frames]),
        body=tryon.model.body.vertices(thin.rotations, betas, thin.translation),
        garment_faces=tryon.garment.faces,
        body_faces=tryon.model.body.faces,
        betas=betas,
        motion=thin,
    )


def told(posed: Penetration, canonical: Penetration) -> str:
    """Both counts, in words."""
    worst = int(posed.per_frame.argmax())
    return (
        f"inside the body: {int(posed.inside.sum()):,} of {posed.inside.numel():,} vertices of all frames "
        f"({100 * posed.share:.3f} %) posed, {int(canonical.inside.sum()):,} canonical; most in frame {worst}: "
        f"{int(posed.per_frame[worst])}"
    )
