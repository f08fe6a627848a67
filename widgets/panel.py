"""What `view` returns: a scene that follows controls, shown by the best face that this machine and front end have.

Live (a box of ipywidgets) where they can be had; beside it always a PNG, for front ends and pages without widgets; one
clear line where nothing can draw.
"""

import base64
import html
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from widgets.controls import Button, Control, Group, column, controls_of
from widgets.frontend_bundle import NotBundled
from widgets.gl import CannotDraw
from widgets.page import write_page
from widgets.picture import encoded, picture
from widgets.scene import Scene
from workbench.extras import MissingExtra, missing_extra, require

if TYPE_CHECKING:
    from widgets.live import LiveScene

SIZE = (760, 560)  # pixels of the scene
ROOM, HEIGHT = 1080, 500  # pixels that a notebook has beside the controls; height where views stand side by side
PLOT_SHARE = 0.42  # of a picture's width, where a plot stands beside the scene
OVERSAMPLING = 1  # of the PNG beside a live view: it is seen only where there is no live one

Pixels = UInt8[ndarray, "H W 3"]
Plot = Callable[[tuple[int, int], int], Pixels]  # size, frame -> picture


class Panel:
    """A scene that follows its controls.

    `panel["latent"] = ...` moves a control as a hand would, `panel["latent"]` reads it; `panel.press("random")` presses
    a button.  `.scene` is what is seen now, `.live` the widget, `.picture(size)` pixels, `.page(path)` an HTML file.
    """

    def __init__(
        self,
        groups: Sequence[Group],
        scene: Callable[[], Scene],
        readout: Callable[[], str] = lambda: "",
        *,
        plot: Plot | None = None,
        title: str = "Garment workbench",
        size: tuple[int, int] = SIZE,
        write: Callable[[Path], Path] | None = None,
    ):
        self._write = write
        self.groups, self.title, self.size, self.plot = tuple(groups), title, size, plot
        self.controls: dict[str, Any] = dict(controls_of(groups))
        self._compute, self._read = scene, readout
        self._lock, self._asked, self._held = threading.RLock(), False, 0
        self._frame = 0
        self.scene = scene()
        self.readout = readout()
        for control in self.controls.values():
            if isinstance(control, Control):
                control.listen(self._follow)

    # controls

    def __getitem__(self, name: str) -> Any:
        return self._control(name).value

    def __setitem__(self, name: str, value: Any) -> None:
        self._control(name).set(value)

    def press(self, name: str) -> None:
        """Press a button."""
        button = self.controls.get(name)
        if not isinstance(button, Button):
            raise KeyError(f"there is no button {name!r}; there are: {', '.join(self._names(Button)) or 'none'}")
        button.press()

    @property
    def frame(self) -> int:
        """The frame that is seen."""
        return self.live.frame if "_live" in self.__dict__ and self._live is not None else self._frame

    @frame.setter
    def frame(self, frame: int) -> None:
        self.scene.at(frame)  # its message where there is no such frame
        self._frame = frame % self.scene.frames
        if "_live" in self.__dict__ and self._live is not None:
            self._live.frame = self._frame

    # faces

    def layer(self, name: str, view: int = 0) -> Any:
        """What is seen now under a name, such as layer("garment").vertices, in one of the views side by side.

        Errors: KeyError naming the layers there are.
        """
        layers = self.scene.views[view].layers
        for layer in layers:
            if layer.name == name:
                return layer
        raise KeyError(f"view {view} has no layer {name!r}; it has {', '.join(layer.name for layer in layers)}")

    @property
    def live(self) -> "LiveScene":
        """The scene's widget.  Raises MissingExtra without anywidget, NotBundled without the browser's code."""
        if self._live is None:
            raise self._fault  # pyright: ignore[reportGeneralTypeIssues]
        return self._live

    def picture(self, size: tuple[int, int] | None = None, oversampling: int = 2) -> Pixels:
        """What is seen now, drawn without a browser.  Raises CannotDraw on a machine without GL."""
        width, height = size or self._whole()
        if self.plot is None:
            return picture(fitted(self.scene, self.size, (width, height)), (width, height), self.frame, oversampling)
        aside = round(width * PLOT_SHARE)
        room = (width - aside, height)
        left = picture(fitted(self.scene, self.size, room), room, self.frame, oversampling)
        return np.concatenate([left, self.plot((aside, height), self.frame)], axis=1)

    def page(self, path: str | Path) -> Path:
        """The scene as one HTML file, which works offline, without the controls.  Raises NotBundled."""
        if self._write is not None:
            return self._write(Path(path))
        return write_page(path, self.scene, f"{self.title}: {self.readout}" if self.readout else self.title)

    @cached_property
    def box(self) -> Any:
        """Controls and live scene as one ipywidget.  Errors as `live`'s."""
        widgets = require("ipywidgets", "lab")
        live = self.live
        self._line = widgets.HTML(_line(self.readout))
        seen: list[Any] = [live, self._line]
        if self.plot is not None:
            self._image = widgets.Image(format="png", value=self._plotted())
            live.observe(lambda _: self._redraw(), "frame")
            seen.insert(1, self._image)
        right = widgets.VBox(seen, layout={"width": f"{self.size[0]}px", "flex": "0 1 auto"})
        return widgets.HBox([column(self.groups), right] if self.groups else [right])

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        bundle: dict[str, Any] = {}
        faults: list[str] = []
        try:
            bundle |= self.box._repr_mimebundle_(include=include, exclude=exclude)
        except (MissingExtra, NotBundled) as reason:
            faults.append(f"not live: {reason}")
        try:
            bundle["image/png"] = base64.b64encode(encoded(self.picture(None, OVERSAMPLING))).decode("ascii")
        except (CannotDraw, ValueError) as reason:
            faults.append(str(reason))
        bundle["text/plain"] = "; ".join([part for part in (self.title, self.readout, *faults) if part])
        return bundle

    def _whole(self) -> tuple[int, int]:
        """Pixels of the scene with its plot beside it."""
        width, height = self.size
        return (width if self.plot is None else round(width / (1 - PLOT_SHARE)), height)

    # following

    def held(self) -> "_Held":
        """`with panel.held():` several controls are moved, and the scene follows once."""
        return _Held(self)

    def _follow(self) -> None:
        """Compute the scene for the present values.  Jupyter calls from several threads: those that come while it is
        computed are all answered by one more computation."""
        self._asked = True
        if self._held:
            return
        with self._lock:
            if self._asked:
                self._asked = False
                self._renew()

    def _renew(self) -> None:
        try:
            self.scene = self._compute()
        except ValueError as reason:
            if "_live" in self.__dict__ and self._live is not None:
                self._live.tell(str(reason))
            raise
        self.readout = self._read()
        self._frame = min(self._frame, self.scene.frames - 1)
        if "_live" in self.__dict__ and self._live is not None:
            self._live.renew(self.scene)
        if "box" in self.__dict__:
            self._line.value = _line(self.readout)
            self._redraw()

    def _redraw(self) -> None:
        if self.plot is not None:
            self._image.value = self._plotted()

    def _plotted(self) -> bytes:
        assert self.plot is not None
        return encoded(self.plot((self.size[0], round(0.45 * self.size[0])), self.frame))

    @cached_property
    def _live(self) -> "LiveScene | None":
        try:
            from widgets.live import LiveScene  # needs the extra `lab`

            return LiveScene(self.scene, self.size)
        except NotBundled as reason:
            self._fault: Exception = reason
        except ModuleNotFoundError as error:
            missing = missing_extra(error)
            if missing is None:
                raise
            self._fault = missing
        return None

    def _control(self, name: str) -> Control:
        control = self.controls.get(name)
        if not isinstance(control, Control):
            raise KeyError(f"there is no control {name!r}; there are: {', '.join(self._names(Control)) or 'none'}")
        return control

    def _names(self, kind: type) -> list[str]:
        return [name for name, item in self.controls.items() if isinstance(item, kind)]


class _Held:
    def __init__(self, panel: Panel):
        self.panel = panel

    def __enter__(self) -> None:
        self.panel._held += 1

    def __exit__(self, *_: object) -> None:
        self.panel._held -= 1
        if self.panel._asked:
            self.panel._follow()


def size_for(views: int) -> tuple[int, int]:
    """Pixels for some views side by side: a body is higher than wide."""
    return (SIZE[0] if views <= 2 else ROOM, SIZE[1] if views <= 2 else HEIGHT)


def fitted(scene: Scene, made_for: tuple[int, int], size: tuple[int, int]) -> Scene:
    """The scene with its own camera moved back where a picture is narrower than the one it was made for."""
    narrower = (made_for[0] / made_for[1]) / (size[0] / size[1])
    camera = scene.camera
    if camera is None or narrower <= 1:
        return scene
    position, target = np.array(camera.position), np.array(camera.target)
    back = target + narrower * (position - target)
    return replace(scene, camera=replace(camera, position=(float(back[0]), float(back[1]), float(back[2]))))


def _line(text: str) -> str:
    return f"<span style='font: 13px system-ui'>{html.escape(text)}</span>"
