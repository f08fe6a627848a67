"""Live views in a real JupyterLab with its default settings: the hand changes pixels, and what is wrong is said."""

import io
import re

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

import widgets.jupyterlab
from widgets.jupyterlab import Watched, grab, jupyterlab, open_notebook, page_megabytes

pytestmark = pytest.mark.browser

CELLS = {
    "imports": """
import ipywidgets, numpy as np, torch, trimesh
import widgets.gl
from widgets.live import LiveScene
from widgets.scene import Camera, Mesh, Scalars, Scene, View, dressed
from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.garments import Garment

able = widgets.gl.fault
found = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
ball, faces = np.asarray(found.vertices, np.float32), np.asarray(found.faces)
print("ready")
""",
    "slider": """
body, garment = Body.default(), Garment.load("tshirt")
model, rest = GarmentModel(body, GridFields.default(body)), body.rest_rotations()

def shown(beta):
    betas = beta * torch.eye(body.shape_count)[0]
    cloth = model.posed(garment.vertices, model.state(rest, betas))
    both = dressed(body.vertices(rest, betas).numpy(), body.faces.numpy(), cloth.numpy(), garment.faces.numpy())
    return Scene((both,), Camera((0.9, -4.4, 1.4), (0, 0, 0.85)))

live = LiveScene(shown(0.0), (640, 480))
slider = ipywidgets.FloatSlider(min=-3, max=3, step=0.01, layout=ipywidgets.Layout(width="640px"))
slider.observe(lambda change: live.renew(shown(change["new"])), "value")
ipywidgets.VBox([slider, live])
""",
    "moving": """
shift = np.linspace(-0.4, 0.4, 24)[:, None, None] * np.array([1.0, 0, 0])
moving = Scene((View((Mesh(ball + shift, faces, name="ball", scalars=Scalars(ball[:, 2], "height", "m")),)),))
live, told = LiveScene(moving, (480, 360)), ipywidgets.Label("nothing yet")

def tell_frame(change):
    told.value = f"frame {change['new']}"

def tell_picked(change):
    x, y, z = (ball + shift)[change["new"]["frame"], change["new"]["vertex"]]
    told.value = f"vertex {change['new']['vertex']} at {x:.4f}, {y:.4f}, {z:.4f}"

live.observe(tell_frame, "frame")
live.observe(tell_picked, "picked")
ipywidgets.VBox([told, live])
""",
    "stream": """
def sized(size):
    return Scene((View((Mesh(size * ball, faces),)),), Camera((0, -3, 0), (0, 0, 0)))

widgets.gl.fault = able
live = LiveScene(sized(0.5), (320, 240), refuse_webgl=True)
slider = ipywidgets.FloatSlider(0.5, min=0.5, max=1.0, step=0.01)
slider.observe(lambda change: live.renew(sized(change["new"])), "value")
ipywidgets.VBox([slider, live])
""",
    "nobody draws": """
widgets.gl.fault = lambda: "GL libraries are missing"
live = LiveScene(sized(0.5), (320, 240), refuse_webgl=True)
live
""",
    "nan": """
torn = ball.copy()
torn[ball[:, 2] > 0.3] = np.nan
LiveScene(Scene((View((Mesh(torn, faces, name="torn ball"),)),)), (320, 240))
""",
    "nothing but nan": """
LiveScene(Scene((View((Mesh(np.full_like(ball, np.nan), faces, name="lost"),)),)), (320, 240))
""",
    "large": """
side = np.linspace(-1, 1, 1000, dtype=np.float32)
sheet = np.stack([*np.meshgrid(side, side), np.zeros((1000, 1000), np.float32)], -1).reshape(-1, 3)
corner = (np.arange(999)[:, None] * 1000 + np.arange(999)).reshape(-1, 1)
cells = np.concatenate([corner + [0, 1, 1001], corner + [0, 1001, 1000]])
LiveScene(Scene((View((Mesh(sheet, cells, name="sheet"),)),), Camera((0, -1, 3), (0, 0, 0))), (320, 240))
""",
}
ORDER = list(CELLS)
MOVES = 100  # `workbench evaluate views` makes 1,000
WEBGL, STREAM = ".wbv[data-drawn]", ".wbv-fallback[data-drawn]"


@pytest.fixture(scope="module")
def lab(tmp_path_factory, shown_browser):
    with jupyterlab(tmp_path_factory.mktemp("lab")) as running:
        yield running


@pytest.fixture(scope="module")
def notebook(lab, shown_browser):
    page = shown_browser.new_page(viewport={"width": 1200, "height": 850})
    opened = open_notebook(page, lab, "views", list(CELLS.values()))
    opened.run(0, 'text="ready"')
    yield opened
    page.close()


@pytest.fixture(autouse=True)
def quiet(notebook):
    """Nothing may be wrong on the console after any test."""
    notebook.troubles.clear()
    yield
    assert notebook.troubles == []


def pixels(element) -> np.ndarray:
    """What the screen shows of an element."""
    return np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("RGB")).astype(int)


def differing(before: np.ndarray, after: np.ndarray) -> float:
    """The share of pixels that are another colour."""
    return float((np.abs(before - after).max(axis=-1) > 20).mean())


def run(notebook, name: str, shows: str):
    """The view of a cell that has been run, and the cell."""
    return notebook.run(ORDER.index(name), shows), notebook.page.locator(".jp-CodeCell").nth(ORDER.index(name))


def test_a_slider_changes_the_pixels_and_nothing_grows(notebook, lab):
    page = notebook.page
    view, cell = run(notebook, "slider", WEBGL)
    assert view.bounding_box()["width"] == 640
    before = pixels(view.locator("canvas").first)
    watched, readout = Watched.of(view), cell.locator(".widget-readout")
    assert readout.inner_text() == "0.00"
    x, y = grab(page, cell.locator(".noUi-handle"))
    for step in range(20):  # there, and what is made once is made
        assert watched.delay(lambda step=step: page.mouse.move(x + 5 * (step + 1), y)) > 0
    assert float(readout.inner_text()) > 0.5
    held = page_megabytes(page), lab.kernels()[-1].memory_info().rss / 1e6
    for move in range(MOVES):
        watched.delay(lambda move=move: page.mouse.move(x + 100 - 4 * (move % 40) - 3, y))
    page.mouse.up()
    grown = page_megabytes(page) - held[0], lab.kernels()[-1].memory_info().rss / 1e6 - held[1]
    assert differing(before, pixels(view.locator("canvas").first)) > 0.01
    assert grown[0] <= 50 * MOVES / 1000
    assert grown[1] <= 30  # the allocator's own steps are some megabytes


def test_playing_and_scrubbing_change_the_pixels_and_the_kernel_learns_where_they_ended(notebook):
    page = notebook.page
    view, cell = run(notebook, "moving", WEBGL)
    told, canvas = cell.locator(".widget-label"), view.locator("canvas").first
    left = pixels(canvas)
    view.locator(".wbv-play").click()
    page.wait_for_function("view => +view.dataset.frame >= 8", arg=view.element_handle())
    view.locator(".wbv-play").click()
    stopped = int(view.get_attribute("data-frame"))
    expect(told).to_have_text(f"frame {stopped}")
    assert differing(left, pixels(canvas)) > 0.05
    _, y = grab(page, view.locator(".wbv-range"))
    box = view.locator(".wbv-range").bounding_box()
    page.mouse.move(box["x"] + box["width"] - 2, y, steps=8)
    page.mouse.up()
    expect(view).to_have_attribute("data-frame", "23")
    expect(told).to_have_text("frame 23")
    right = pixels(canvas)
    assert differing(left, right) > 0.05
    page.keyboard.press("Home")
    expect(view).to_have_attribute("data-frame", "0")
    expect(view.locator(".wbv-count")).to_have_text("0 / 23")
    assert differing(right, pixels(canvas)) > 0.05


def test_a_click_reads_the_vertex_that_the_kernel_holds(notebook):
    view, cell = run(notebook, "moving", WEBGL)
    canvas = view.locator("canvas").first
    box = canvas.bounding_box()
    canvas.click(position={"x": 0.3 * box["width"], "y": 0.5 * box["height"]})
    told = cell.locator(".widget-label")
    expect(told).to_have_text(re.compile("vertex .* at"))
    vertex, place = re.fullmatch(r"vertex (\d+) at (.*)", told.inner_text()).groups()  # pyright: ignore[reportOptionalMemberAccess]
    read = view.locator(".wbv-read").inner_text()
    assert read.startswith(f"ball, vertex {vertex}")
    seen = re.search(r"(-?[\d.]+), (-?[\d.]+), (-?[\d.]+) m", read)
    assert seen
    np.testing.assert_allclose([float(g) for g in seen.groups()], [float(w) for w in place.split(",")], atol=2e-4)
    height = re.search(r"height\s+(-?[\d.]+) m", read)
    assert height
    assert float(height[1]) == pytest.approx(float(seen[3]), abs=2e-4)


def test_keys_and_buttons_are_named(notebook):
    view, _ = run(notebook, "moving", WEBGL)
    for button in view.locator("button").all():
        assert button.get_attribute("title") or button.inner_text().strip().isalpha()
        assert button.get_attribute("aria-label") or button.inner_text().strip().isalpha()
    view.locator("canvas").first.click(position={"x": 5, "y": 350})
    notebook.page.keyboard.press("?")
    expect(view.locator(".wbv-help")).to_be_visible()
    assert "play, pause" in view.locator(".wbv-help").inner_text()
    notebook.page.keyboard.press("Escape")
    expect(view.locator(".wbv-help")).not_to_be_visible()


def test_without_webgl_the_kernel_draws_and_a_slider_changes_its_pictures(notebook):
    page = notebook.page
    view, cell = run(notebook, "stream", STREAM)
    assert "No WebGL" in view.inner_text()
    image = view.locator("img")
    before = pixels(image)
    assert differing(before, np.full_like(before, before[0, 0])) > 0.05  # a ball, not a blank
    watched = Watched.of(view)
    x, y = grab(page, cell.locator(".noUi-handle"))
    watched.delay(lambda: page.mouse.move(x + 60, y))
    page.mouse.up()
    watched.settle()
    assert differing(before, pixels(image)) > 0.05
    far = pixels(image)
    image.hover()
    watched.delay(lambda: page.mouse.wheel(0, -400))
    watched.settle()
    assert differing(far, pixels(image)) > 0.05


def test_where_neither_browser_nor_kernel_can_draw_the_view_says_what_to_do(notebook):
    fault, _ = run(notebook, "nobody draws", ".wbv-fault")
    assert fault.inner_text() == (
        "Neither the browser nor the kernel can draw: this machine cannot draw (GL libraries are missing): run "
        "apt-get install -y libgl1 libegl1 libxrender1"
    )


def test_nan_vertices_are_left_out_and_counted(notebook):
    view, _ = run(notebook, "nan", WEBGL)
    assert re.search(r"torn ball: \d+ vertices are NaN or infinite; they are not drawn", view.inner_text())
    shown = pixels(view.locator("canvas").first)
    assert differing(shown, np.full_like(shown, shown[0, 0])) > 0.1


def test_a_view_without_any_finite_vertex_says_so(notebook):
    view, _ = run(notebook, "nothing but nan", WEBGL)
    assert "lost: 642 vertices are NaN or infinite" in view.inner_text()
    assert "there is nothing to look at: the scene has no finite point" in view.inner_text()


def test_a_million_vertices_are_drawn_with_a_warning(notebook):
    view, _ = run(notebook, "large", WEBGL)
    assert "sheet: 1,000,000 vertices; turning it may be slow" in view.inner_text()
    shown = pixels(view.locator("canvas").first)
    assert differing(shown, np.full_like(shown, shown[0, 0])) > 0.1


def test_a_dead_kernel_is_told_in_the_views(notebook, lab):
    live, _ = run(notebook, "moving", WEBGL)
    stream, _ = run(notebook, "stream", STREAM)
    lab.kernels()[-1].kill()
    expect(live.locator(".wbv-note")).to_contain_text("The kernel is gone", timeout=60_000)
    expect(stream.locator(".wbv-note")).to_contain_text("The kernel is gone", timeout=60_000)
    before = live.get_attribute("data-frame")
    live.locator(".wbv-play").click()  # frames are in the browser
    expect(live).not_to_have_attribute("data-frame", before)
    notebook.troubles.clear()  # JupyterLab tells of its kernel's end on the console


def test_a_cell_whose_keys_were_lost_is_run_again(shown_browser, tmp_path, monkeypatch):
    page, pressed = shown_browser.new_page(), []
    with jupyterlab(tmp_path) as lab:
        opened = open_notebook(page, lab, "deaf", ["print('heard')"])
        keyboard = type(page.keyboard)
        real = keyboard.press

        def press(self, key):
            pressed.append(key)
            if len(pressed) > 1:
                real(self, key)

        monkeypatch.setattr(keyboard, "press", press)
        monkeypatch.setattr(widgets.jupyterlab, "UNHEARD", 3.0)
        opened.run(0, 'text="heard"')
        assert len(pressed) >= 2
        page.close()
