"""`workbench evaluate views`: the views in a real JupyterLab and Chromium -> milliseconds, frames a second, megabytes.

WebGL by the processor, 640 x 480, the default body and the T-shirt.  A delay runs from the event of the mouse to pixels
that differ, read back, so that they have been drawn.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from widgets.jupyterlab import (
    PATIENCE,
    JupyterLab,
    Watched,
    browser,
    grab,
    jupyterlab,
    open_notebook,
    page_megabytes,
    renderer_megabytes,
)
from widgets.page import write_page
from widgets.scene import Scene, dressed
from workbench.body.model import Body
from workbench.collisions.sequences import shipped_sequence
from workbench.evaluation_table import Row, at_least, at_most, told

SHAPE = """
import ipywidgets, torch
from widgets.live import LiveScene
from widgets.scene import Camera, Scene, dressed
from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.garments import Garment

body, garment = Body.default(), Garment.load("tshirt")
model, rest = GarmentModel(body, GridFields.default(body)), body.rest_rotations()

def shown(beta):
    betas = beta * torch.eye(body.shape_count)[0]
    cloth = model.posed(garment.vertices, model.state(rest, betas))
    both = dressed(body.vertices(rest, betas).numpy(), body.faces.numpy(), cloth.numpy(), garment.faces.numpy())
    return Scene((both,), Camera((0.9, -4.4, 1.4), (0.0, 0.0, 0.85)))

live = LiveScene(shown(0.0), (640, 480))
slider = ipywidgets.FloatSlider(min=-3, max=3, step=0.01, layout=ipywidgets.Layout(width="640px"))
slider.observe(lambda change: live.renew(shown(change["new"])), "value")
ipywidgets.VBox([slider, live])
"""
MOTION = """
from widgets.live import LiveScene
from widgets.view_evaluation import motion

LiveScene(motion(60), (640, 480))
"""
LATENT = """
from widgets.view import view
from workbench.collisions.subspace import Subspace

view(Subspace.shipped("tshirt"))
"""
VIEW = ".wbv[data-drawn]"
WARM = 10  # moves before those that count
PLAYED = 5.0  # seconds


@dataclass(frozen=True)
class ViewEvaluation:
    """Timings and memory of the views; on a busy machine trust the ratios."""

    moves: int = 40  # of each slider, for the medians
    many_moves: int = 1000  # whose memory is looked at


def rows(config: ViewEvaluation) -> list[Row]:
    """Everything in one browser.  Raises NoChromium where there is none."""
    with tempfile.TemporaryDirectory() as folder:
        table = [page_row(Path(folder))]
        with jupyterlab(Path(folder)) as lab, browser() as shown:
            page = shown.new_page(viewport={"width": 1500, "height": 1000})
            notebook = open_notebook(page, lab, "views", [SHAPE, MOTION, LATENT])
            cell = page.locator(".jp-CodeCell")
            view = notebook.run(0, VIEW)
            table += shape_rows(view, cell.nth(0), lab, shown, config)
            table += motion_rows(notebook.run(1, VIEW), config)
            watched = Watched.of(notebook.run(2, VIEW))
            handle = cell.nth(2).locator(".widget-hslider", has_text="latent 1").first.locator(".noUi-handle")
            delays = dragged(watched, handle, config.moves)
            table.append(at_most("latent slider to decoded, recounted, drawn: median", median(delays), "ms", 250))
            table.append(at_most("errors on the browser's console", len(notebook.troubles), "", 0))
    return table


def shape_rows(view: Any, cell: Any, lab: JupyterLab, shown: Any, config: ViewEvaluation) -> list[Row]:
    """A slider whose every move the kernel answers: its delay, and what many moves leave behind."""
    watched, handle = Watched.of(view), cell.locator(".noUi-handle").last
    delays = dragged(watched, handle, config.moves)
    kernel = lab.kernels()[-1]

    def held() -> np.ndarray:
        return np.array([kernel.memory_info().rss / 1e6, page_megabytes(view.page), renderer_megabytes(shown)])

    before = held()
    dragged(watched, handle, config.many_moves, settled=False)
    grown = held() - before
    many = f"{config.many_moves:,} slider moves"
    return [
        at_most("slider to changed pixels, with the kernel: median", median(delays), "ms", 200),
        told("slider to changed pixels, with the kernel: slowest tenth", float(np.quantile(delays, 0.9)), "ms"),
        at_most(f"{many}: growth of the kernel", grown[0], "MB", 30),
        at_most(f"{many}: growth of the page's scripts", grown[1], "MB", 50),
        at_most(f"{many}: growth of the browser's processes of pages", grown[2], "MB", 50),
    ]


def motion_rows(view: Any, config: ViewEvaluation) -> list[Row]:
    """Scrubbing and playing, which need no kernel."""
    watched, page = Watched.of(view), view.page
    track = view.locator(".wbv-range")
    track.scroll_into_view_if_needed()
    box = track.bounding_box()
    left, y = box["x"] + 10, box["y"] + box["height"] / 2
    page.mouse.move(left, y)
    page.mouse.down()
    delays = []
    for move in range(WARM + config.moves):
        x = left + (box["width"] - 20) * ((7 * move + 20) % 60) / 60
        delays.append(watched.delay(lambda x=x: page.mouse.move(x, y)))
        watched.settle()
    page.mouse.up()
    view.locator(".wbv-play").click()
    page.wait_for_function("watched.changes.length > 5", timeout=1e3 * PATIENCE)
    page.evaluate("watched.changes.length = 0")
    page.wait_for_function(f"watched.changes.at(-1) - watched.changes[0] > {1e3 * PLAYED}", timeout=1e3 * PATIENCE)
    times = watched.changes()
    view.locator(".wbv-play").click()
    return [
        at_most("scrubbing to changed pixels: median", median(delays[WARM:]), "ms", 60),
        at_least("playing: frames shown", 1e3 * (len(times) - 1) / (times[-1] - times[0]), "1/s", 12),
    ]


def dragged(watched: Watched, handle: Any, moves: int, settled: bool = True) -> list[float]:
    """Drag a slider to and fro by hand; the delay of every move after the first few."""
    page = watched.page
    x, y = grab(page, handle)
    delays = []
    for move in range(WARM + moves):
        step = move % 40
        to = x + 2 * (step if step < 20 else 40 - step) + 2  # the shortest slider ends 50 pixels off its middle
        delays.append(watched.delay(lambda to=to: page.mouse.move(to, y)))
        if settled:
            watched.settle()
    page.mouse.up()
    return delays[WARM:]


def page_row(folder: Path) -> Row:
    """The file that a colleague gets."""
    path = write_page(folder / "tryon.html", motion(120))
    return at_most("page of a try-on of 120 frames", path.stat().st_size / 1e6, "MB", 8)


@torch.no_grad()
def motion(frames: int) -> Scene:
    """The body in the T-shirt that was simulated on it, there and back."""
    body, sequence = Body.default(), shipped_sequence("tshirt_demo")
    there = np.arange(len(sequence))
    taken = np.resize(np.concatenate([there, there[-2:0:-1]]), frames)
    bodies = body.vertices(sequence.rotations, sequence.betas, sequence.translation).numpy()[taken]
    marked = np.zeros((frames, sequence.garment.shape[1]), bool)
    return Scene(
        (dressed(bodies, body.faces.numpy(), sequence.garment.numpy()[taken], sequence.faces.numpy(), marked),)
    )
