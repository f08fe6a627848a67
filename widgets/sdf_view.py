"""Eq. 12's SDF to look at: BodySDF -> cuts through space, their zero line, and level sets; several side by side."""

import functools

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from widgets.controls import Choice, Group, Number
from widgets.panel import Panel, size_for
from widgets.picture import RENDER_THREAD
from widgets.scene import SKIN, Mesh, Scalars, Scene, View
from widgets.slice_plane import MARGIN, SliceControls, tensor_of
from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF, ExactSDF, GridSDF, LearnedSDF

MILLI = 1e3
CUT, ERROR, LEVEL = "cut", "error of the cut", "level set"
LIMIT = 200.0  # millimetres at both ends of the colour map
WRONG = (0.0, 5.0)  # millimetres
GHOST = 0.25
POINTS = {ExactSDF: 120, LearnedSDF: 100, GridSDF: 160}  # on the longer side of a cut
COARSEST = 100
LATTICE: dict[type[BodySDF], float] = {GridSDF: 0.02}  # metres between the points in which a level set is looked for
COARSE_LATTICE = 0.03
NAMES = {ExactSDF: "exact", LearnedSDF: "network", GridSDF: "table"}


def sdf_view(
    sdf: BodySDF, *others: BodySDF, body: Body | None = None, names: tuple[str, ...] = (), across: int | None = None
) -> Panel:
    """`others` are shown beside it, on the same cut; with "error" they are coloured by their distance to the exact one.

    `body` is the one the distances are to, by default the default body.
    """
    shown, body = (sdf, *others), body or Body.default()
    names = names or tuple(NAMES.get(type(one), type(one).__name__) for one in shown)
    if len(names) != len(shown):
        raise ValueError(f"{len(names)} names for {len(shown)} distances")
    across = across or min(POINTS.get(type(one), COARSEST) for one in shown)
    cut = SliceControls.around(body.template)
    lattice = max(LATTICE.get(type(one), COARSE_LATTICE) for one in shown)  # one for all, to compare them
    look = Choice("look", (CUT, ERROR, LEVEL))
    level = Number("level (mm)", 0.0, -30.0, 100.0, 5.0, "0: the body's surface; above: that far outside")
    ghost = Mesh(body.template.numpy(), body.faces.numpy(), SKIN, GHOST, name="body")
    low, high = body.template.amin(0).numpy() - MARGIN, body.template.amax(0).numpy() + MARGIN
    exact = functools.cache(lambda: ExactSDF(body))
    blocks: dict[int, Block] = {}
    size = size_for(len(shown))

    @torch.no_grad()
    def scene() -> Scene:
        plane, views = cut.plane(across), []
        for index, (one, name) in enumerate(zip(shown, names, strict=True)):
            if look.value == LEVEL:
                if index not in blocks:
                    blocks[index] = Block.of(one, low, high, lattice)
                vertices, faces = blocks[index].level_set(level.value / MILLI)
                shell = Mesh(vertices, faces, (0.55, 0.68, 0.62), name="level set")
                layers = (ghost, shell) if level.value else (shell,)  # at 0 the one would hide the other
                views.append(View(layers, f"{name}: {level.value:g} mm"))
                continue
            values = one(tensor_of(plane)).numpy()
            coloured = Scalars(MILLI * values, "distance, inside < 0", "mm", (-LIMIT, LIMIT), "RdBu")
            if look.value == ERROR:
                wrong = MILLI * np.abs(values - exact()(tensor_of(plane)).numpy())
                coloured = Scalars(wrong, "error", "mm", WRONG, "magma")
            line = plane.level_line(values, 0.0, "zero line")
            views.append(View((ghost, plane.coloured(coloured), line), name))
        return Scene(tuple(views), cut.camera(size[0] / len(shown) / size[1]))

    @torch.no_grad()
    def readout() -> str:
        points = tensor_of(cut.plane(across))
        truth, parts = exact()(points), []
        for one, name in zip(shown, names, strict=True):
            values = one(points)
            wrong, sign = MILLI * (values - truth).abs(), ((values < 0) != (truth < 0)).float().mean()
            parts.append(f"{name}: {float(wrong.mean()):.2f} mm, {100 * float(sign):.2f} %")
        where = f"cut at {'xyz'[cut.axis]} = {cut.position:.2f} m; mean error on it and share of wrong signs"
        return f"{where}: {'; '.join(parts)}"

    return Panel(
        (Group("What is seen", (look, level)), cut.group),
        scene,
        readout,
        title="Signed distance to the constant body",
        size=size,
    )


class Block:
    """A distance on a regular lattice, for level sets."""

    def __init__(self, values: Float[ndarray, "x y z"], low: Float[ndarray, "3"], step: float):
        self.values, self.low, self.step = values, low, step

    @staticmethod
    def of(sdf: BodySDF, low: Float[ndarray, "3"], high: Float[ndarray, "3"], step: float) -> "Block":
        lines = [np.arange(a, b + step, step, dtype=np.float32) for a, b in zip(low, high, strict=True)]
        points = torch.from_numpy(np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3))
        values = torch.cat([sdf(part) for part in points.split(1 << 15)])
        return Block(values.reshape([len(line) for line in lines]).numpy(), low, step)

    def level_set(self, level: float) -> tuple[Float[ndarray, "V 3"], Int[ndarray, "F 3"]]:
        """The surface where the distance is `level` (metres).  ValueError where there is none."""
        return RENDER_THREAD.submit(self._contour, level).result()

    def _contour(self, level: float) -> tuple[ndarray, ndarray]:
        import pyvista

        block = pyvista.ImageData(dimensions=self.values.shape, spacing=[self.step] * 3, origin=self.low.tolist())
        block["distance"] = self.values.ravel(order="F")
        shell = block.contour([level], scalars="distance")
        if shell.n_points == 0:
            raise ValueError(f"the distance is {MILLI * level:g} mm nowhere in the box; choose another level")
        return np.asarray(shell.points), shell.regular_faces.astype(np.int64)
