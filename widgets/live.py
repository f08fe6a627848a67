"""Scene -> a notebook's browser: anywidget and three.js, with a fallback that never crashes.

The scene is a trait, so that a view opened later starts from what is current.  A change is ONE message with those
arrays that differ: header and buffers arrive together, and nothing else of the scene is sent again.
Where the browser has no WebGL it asks for pictures, which the kernel draws on its one render thread.
"""

import logging
import uuid
from dataclasses import replace
from typing import Any

import anywidget
import traitlets

from widgets.frontend_bundle import bundled
from widgets.gl import CannotDraw
from widgets.picture import encoded, picture
from widgets.scene import Camera, Scene
from widgets.wire import Wire, encode

log = logging.getLogger(__name__)


class LiveScene(anywidget.AnyWidget):
    """The widget.  `frame` and `picked` (layer, vertex, frame) are what the hand in the browser left behind."""

    _esm = traitlets.Unicode().tag(sync=True)
    scene = traitlets.Dict().tag(sync=True)
    size = traitlets.List(trait=traitlets.Int()).tag(sync=True)
    frame = traitlets.Int(0).tag(sync=True)
    picked = traitlets.Dict().tag(sync=True)
    key = traitlets.Unicode().tag(sync=True)  # by which the browser finds the store of this model
    refuse_webgl = traitlets.Bool(False).tag(sync=True)  # draw in the kernel although the browser could

    def __init__(self, shown: Scene, size: tuple[int, int] = (900, 560), **traits: Any):
        """Raises NotBundled where the package was built without Node; ValueError as `widgets.wire.encode`."""
        self._shown = shown
        wire = _encoded(shown, size)
        buffers = {key: array.tobytes() for key, array in wire.arrays.items()}
        super().__init__(
            _esm=bundled("view.js"),
            scene={"header": wire.header, "buffers": buffers},
            size=list(size),
            key=uuid.uuid4().hex,
            **traits,
        )
        self.on_msg(self._answer)

    def renew(self, shown: Scene) -> None:
        """Show another scene; frame and camera stay.

        A scene that is refused (ValueError as `widgets.wire.encode`) leaves the old one, and the view says why.
        """
        try:
            wire = _encoded(shown, (self.size[0], self.size[1]))
        except ValueError as reason:
            self.tell(f"Not shown: {reason}")
            raise
        known = self.scene["buffers"]
        buffers = {key: array.tobytes() for key, array in wire.arrays.items()}
        changed = [key for key in buffers if known.get(key) != buffers[key]]
        self._shown = shown
        # in place: the trait is what a view opened later reads, the message is what open ones need
        for key in set(known) - set(buffers):
            del known[key]
        known.update(buffers)
        self.scene["header"] = wire.header
        self.send({"kind": "renew", "header": wire.header, "keys": changed}, [buffers[key] for key in changed])

    def tell(self, text: str) -> None:
        """A line of text over the view, such as why a change was refused."""
        self.send({"kind": "fault", "text": text})

    def _answer(self, _: Any, message: dict[str, Any], __: Any) -> None:
        """The browser asks for a picture because it has no WebGL."""
        if message.get("kind") != "draw":
            return
        try:
            looked_at = replace(self._shown, camera=_camera(message["camera"]))
            pixels = picture(looked_at, (self.size[0], self.size[1]), int(message["frame"]), oversampling=1)
            self.send({"kind": "picture"}, [encoded(pixels, "JPEG")])
        except CannotDraw as reason:
            self.tell(f"Neither the browser nor the kernel can draw: {reason}")
        except Exception as reason:  # Jupyter would hide it in a log, and the view would wait for ever
            self.tell(f"The kernel could not draw this: {reason}")
            raise


def _camera(told: dict[str, Any]) -> Camera:
    """The browser's camera; JavaScript does not tell 3.0 from 3."""
    position, target, up = ([float(x) for x in told[name]] for name in ("position", "target", "up"))
    return Camera(
        (position[0], position[1], position[2]),
        (target[0], target[1], target[2]),
        (up[0], up[1], up[2]),
        float(told["angle"]),
    )


def _encoded(scene: Scene, size: tuple[int, int]) -> Wire:
    rows = -(-len(scene.views) // max(scene.columns or len(scene.views), 1))
    columns = scene.columns or max(len(scene.views), 1)
    return encode(scene, aspect=(size[0] / columns) / (size[1] / max(rows, 1)))
