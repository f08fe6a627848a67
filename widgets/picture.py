"""Scene, frame -> PNG, through pyvista without a display.

VTK draws black, without an error, from any thread but the one that made its context, and Jupyter runs callbacks in
several.  So every VTK call of this process is made on one thread.
"""

import concurrent.futures
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from widgets import gl
from widgets.colour import category_colours
from widgets.scene import Camera, Layer, Mesh, Points, Scalars, Scene, View
from workbench.store import atomic_write

RENDER_THREAD = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="vtk")

OVERSAMPLING = 2  # drawn larger and averaged: the smoothest edges that software GL gives
KEY, FILL, RIM = (-1.2, -2.0, 2.4), (2.2, -1.5, 0.6), (0.6, 2.2, 1.8)  # lights about the target, in its frame of view
TITLE_SIZE = 13
CORNERS = 6  # of a surfel's disc


def picture(
    scene: Scene, size: tuple[int, int] = (900, 900), frame: int = 0, oversampling: int = OVERSAMPLING
) -> UInt8[ndarray, "H W 3"]:
    """Draw a frame of a scene; `size` is the whole picture's width and height in pixels; `oversampling` 1 is fastest.

    Raises CannotDraw (with the command that mends it) when there is no working GL.
    """
    if not scene.views:
        raise ValueError("there is nothing to draw: the scene has no view")
    if min(size) < 16:
        raise ValueError(f"a picture of {size[0]} x {size[1]} pixels is too small: give at least 16 x 16")
    gl.ensure_can_draw()
    return RENDER_THREAD.submit(_draw, scene.at(frame), size, oversampling).result()


def encoded(pixels: UInt8[ndarray, "H W 3"], kind: str = "PNG") -> bytes:
    """The bytes of an image file: PNG, or JPEG (a tenth of the time and size)."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind)
    return file.getvalue()


def write_picture(path: str | Path, scene: Scene, size: tuple[int, int] = (900, 900), frame: int = 0) -> Path:
    """Draw a frame of a scene into a .png, which appears whole or not at all."""
    from PIL import Image

    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"a picture is written as .png, not as {path.name}")
    pixels = picture(scene, size, frame)
    with atomic_write(path) as part:
        Image.fromarray(pixels).save(part)
    return path


def grid_of(scene: Scene) -> tuple[int, int]:
    """Rows and columns of the views."""
    columns = scene.columns or len(scene.views)
    return math.ceil(len(scene.views) / columns), columns


def discrete_map(scalars: Scalars) -> Any:
    """One colour a category, as matplotlib's colour map."""
    import matplotlib.colors

    return matplotlib.colors.ListedColormap(category_colours(scalars).tolist())


def surfel_rims(
    positions: Float[ndarray, "N 3"], normals: Float[ndarray, "N 3"], radius: float
) -> tuple[Float[ndarray, "R 3"], Int[ndarray, "F 3"]]:
    """A regular hexagon around each point, across its normal: its corners and its four triangles."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    aside = np.where(np.abs(unit[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(unit, aside)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(unit, across)
    angles = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    ring = np.cos(angles)[:, None] * across[:, None] + np.sin(angles)[:, None] * along[:, None]
    corners = positions[:, None] + radius * ring
    fan = np.array([[0, i, i + 1] for i in range(1, CORNERS - 1)])
    faces = (CORNERS * np.arange(len(positions)))[:, None, None] + fan
    return corners.reshape(-1, 3), faces.reshape(-1, 3)


# --- everything below runs on the render thread


def _draw(scene: Scene, size: tuple[int, int], oversampling: int) -> ndarray:
    import pyvista as pv

    rows, columns = grid_of(scene)
    large = [side * oversampling for side in size]
    plotter: Any = pv.Plotter(off_screen=True, window_size=large, shape=(rows, columns), border=False, lighting="none")
    try:
        shared = scene.resolved_camera(aspect=(size[0] / columns) / (size[1] / rows))
        for index in range(rows * columns):
            plotter.subplot(index // columns, index % columns)
            plotter.set_background(scene.background, top=_lighter(scene.background))
            if index < len(scene.views):
                _draw_view(plotter, scene.views[index], shared, oversampling)
        drawn = plotter.screenshot(None, return_img=True)
    finally:
        plotter.close()  # an open plotter keeps 26 MB
        pv.close_all()
    return _shrunk(np.asarray(drawn)[..., :3], size, oversampling)


def _draw_view(plotter: Any, view: View, shared: Camera, oversampling: int) -> None:
    camera = view.camera or shared
    plotter.camera_position = [camera.position, camera.target, camera.up]

    plotter.camera.view_angle = camera.view_angle
    for layer in view.layers:
        if not _on_top(layer):
            _add(plotter, layer, oversampling)
    _light(plotter, camera)
    top = [layer for layer in view.layers if _on_top(layer)]
    if top:
        _add_on_top(plotter, top, oversampling)
    if view.title:
        plotter.add_text(
            view.title, position=(0.03, 0.955), viewport=True, font_size=TITLE_SIZE * oversampling // 2, color="#303030"
        )
    plotter.renderer.ResetCameraClippingRange()


def _on_top(layer: Layer) -> bool:
    return isinstance(layer, Points) and layer.on_top


def _add(plotter: Any, layer: Layer, oversampling: int) -> Any:
    import pyvista as pv

    if isinstance(layer, Mesh):
        surface = pv.PolyData.from_regular_faces(layer.vertices.astype(np.float32), layer.faces)
        look: dict[str, Any] = {
            "color": layer.colour,
            "opacity": layer.opacity,
            "show_edges": layer.edges,
            "edge_color": "#404040",
            "ambient": 0.16,
            "diffuse": 0.9,
            "specular": 0.12,
            "specular_power": 18,
        }
        if layer.smooth:
            # our vertices stay as they are: no splitting at sharp edges, no merging
            surface = surface.compute_normals(
                cell_normals=False, split_vertices=False, consistent_normals=False, auto_orient_normals=False
            )
            look["interpolation"] = "phong"
        _colour(surface, layer, look, oversampling)
        return plotter.add_mesh(surface, **look)
    if isinstance(layer, Points) and layer.normals is not None:
        discs, look = _surfels(layer, oversampling)
        return plotter.add_mesh(discs, **look)
    if isinstance(layer, Points):
        cloud = pv.PolyData(layer.positions.astype(np.float32))
        look = {
            "color": layer.colour,
            "point_size": layer.size * oversampling,
            "render_points_as_spheres": True,
            "ambient": 0.6,
        }
        _colour(cloud, layer, look, oversampling)
        return plotter.add_mesh(cloud, **look)
    return plotter.add_arrows(layer.starts, layer.vectors, mag=1.0, color=layer.colour, show_scalar_bar=False)


def _surfels(layer: Points, oversampling: int) -> tuple[Any, dict[str, Any]]:
    """Discs that face along the normals: one hexagon a point."""
    import pyvista as pv

    assert layer.normals is not None
    rim, faces = surfel_rims(layer.positions, layer.normals, layer.radius)
    discs = pv.PolyData.from_regular_faces(rim.astype(np.float32), faces)
    look: dict[str, Any] = {"color": layer.colour, "ambient": 0.3, "diffuse": 0.8}
    if layer.scalars is not None:
        repeated = replace(layer.scalars, values=np.repeat(layer.scalars.values, CORNERS))
        _colour(discs, replace(layer, positions=rim, normals=None, scalars=repeated), look, oversampling)
    return discs, look


def _colour(data: Any, layer: Mesh | Points, look: dict[str, Any], oversampling: int) -> None:
    if layer.scalars is None:
        return
    scalars = layer.scalars
    title = scalars.label
    data[title] = scalars.values.astype(np.float32)
    look.pop("color")
    look |= {
        "scalars": title,
        "ambient": 0.35,  # a colour is a number here: little shade, no shine
        "diffuse": 0.7,
        "specular": 0.0,
        "cmap": discrete_map(scalars) if scalars.categories else scalars.colour_map,
        "clim": scalars.range(),
        "nan_color": "#bbbbbb",
        "scalar_bar_args": {
            "title": title,
            "n_labels": 2,
            "width": 0.5,
            "position_x": 0.25,
            "position_y": 0.02,
            "height": 0.09,
            "title_font_size": 12 * oversampling,
            "label_font_size": 11 * oversampling,
            "color": "#303030",
            "fmt": "%.3g",
        },
    }
    if scalars.categories or not scalars.legend:
        look["show_scalar_bar"] = False
    if scalars.categories:
        look["interpolate_before_map"] = False


def _light(plotter: Any, camera: Camera) -> None:
    """A studio: a soft key light, a weaker fill, a rim from behind; they stand still in the frame of view."""
    import pyvista as pv

    target, position = np.array(camera.target, float), np.array(camera.position, float)
    towards = position - target
    distance = float(np.linalg.norm(towards))
    towards /= distance
    right = np.cross(np.array(camera.up), towards)
    right /= np.linalg.norm(right)
    above = np.cross(towards, right)
    for offset, colour, intensity in (
        (KEY, "#fff6ea", 1.0),
        (FILL, "#eaf1ff", 0.6),
        (RIM, "#ffffff", 0.45),
    ):
        # offset is (right, away from the camera, up)
        place = target + distance * (offset[0] * right - offset[1] * towards + offset[2] * above)
        light = pv.Light(position=tuple(place), focal_point=tuple(target), color=colour, intensity=intensity)
        plotter.add_light(light, only_active=True)


def _add_on_top(plotter: Any, layers: list[Layer], oversampling: int) -> None:
    """A second renderer over the first, with a depth buffer of its own: the first hides nothing of it."""
    import vtk

    window, below = plotter.render_window, plotter.renderer
    above = vtk.vtkRenderer()
    above.SetLayer(1)
    above.SetViewport(below.GetViewport())
    above.SetActiveCamera(below.GetActiveCamera())
    above.InteractiveOff()
    window.SetNumberOfLayers(2)
    window.AddRenderer(above)
    for layer in layers:
        actor = _add(plotter, layer, oversampling)
        plotter.renderer.RemoveActor(actor)
        above.AddActor(actor)


def _lighter(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    return (min(1.0, colour[0] + 0.03), min(1.0, colour[1] + 0.03), min(1.0, colour[2] + 0.03))


def _shrunk(pixels: ndarray, size: tuple[int, int], oversampling: int) -> ndarray:
    """Mean of each block of pixels."""
    width, height = size
    blocks = pixels[: height * oversampling, : width * oversampling].astype(np.float32)
    blocks = blocks.reshape(height, oversampling, width, oversampling, 3).mean((1, 3))
    return np.round(blocks).astype(np.uint8)
