"""What a view can be asked for: beta, theta, latent, frame, seed, choices.  A value, and its ipywidgets twins.

A control works without a browser, so that a notebook, a test and a hand move the same thing; ipywidgets are made only
when they are shown.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from workbench.extras import require

LABEL, SLIDER = "90px", "300px"  # widths in a column of controls
NARROW = "250px"
KEPT = {"flex": "0 0 auto"}  # a column that scrolls would else squeeze its rows flat

Real = int | float


class Control(ABC):
    """A named value; those who listen are called after each change.

    Errors: ValueError for a value it cannot have.
    """

    def __init__(self, name: str, value: Any, told: str = ""):
        self.name, self.told = name, told
        self._value = self.start = self.checked(value)
        self._listeners: list[Callable[[], None]] = []
        self._twins: list[Any] = []
        self._writing = False

    @property
    def value(self) -> Any:
        return self._value

    @abstractmethod
    def checked(self, value: Any) -> Any:
        """The value as it is kept.  ValueError where it cannot be had."""

    @abstractmethod
    def build(self) -> Any:
        """A new ipywidgets twin, at the present value; `hear` is what it calls."""

    @abstractmethod
    def write(self, twin: Any) -> None:
        """Let a twin show the present value."""

    def set(self, value: Any) -> None:
        """Move the control, its twins, and all that follows from it."""
        value = self.checked(value)
        if value == self._value:
            return
        self._value = value
        self.refresh_twins()
        for listener in self._listeners:
            listener()

    def reset(self) -> None:
        """Back to the value it started with."""
        self.set(self.start)

    def listen(self, listener: Callable[[], None]) -> None:
        self._listeners.append(listener)

    def twin(self) -> Any:
        """An ipywidget that shows the value and sets it.  Raises MissingExtra without ipywidgets."""
        twin = self.build()
        self._twins.append(twin)
        return twin

    def refresh_twins(self) -> None:
        """Let every twin show the present value, without being heard."""
        self._writing = True
        try:
            for twin in self._twins:
                self.write(twin)
        finally:
            self._writing = False

    def hear(self, value: Any) -> None:
        """A hand moved a twin."""
        if not self._writing:
            self.set(value)


class Number(Control):
    """A slider from `low` to `high`; whole numbers where `step` is whole."""

    def __init__(self, name: str, value: Real, low: Real, high: Real, step: Real = 0.1, told: str = ""):
        self.low, self.high, self.step = low, high, step
        super().__init__(name, value, told)

    @property
    def whole(self) -> bool:
        return isinstance(self.step, int)

    def checked(self, value: Any) -> Real:
        value = int(value) if self.whole else float(value)
        if not self.low <= value <= self.high:
            raise ValueError(f"{self.name} goes from {self.low:g} to {self.high:g}, but got {value:g}")
        return value

    def build(self) -> Any:
        twin = _slider(self.name, self._value, self.low, self.high, self.step, self.told)
        twin.observe(lambda change: self.hear(change["new"]), "value")
        return twin

    def write(self, twin: Any) -> None:
        twin.value = self._value


class Vector(Control):
    """Sliders of one range, one a component."""

    def __init__(
        self,
        name: str,
        value: Iterable[Real],
        low: Real,
        high: Real,
        step: Real = 0.1,
        labels: Sequence[str] = (),
        told: str = "",
    ):
        self.low, self.high, self.step = low, high, step
        value = tuple(float(number) for number in value)
        self.labels = tuple(labels) or tuple(f"{name} {index + 1}" for index in range(len(value)))
        super().__init__(name, value, told)

    def checked(self, value: Any) -> tuple[float, ...]:
        value = tuple(float(number) for number in value)
        if len(value) != len(self.labels):
            raise ValueError(f"{self.name} has {len(self.labels)} numbers, but got {len(value)}")
        if not all(isfinite(number) for number in value):
            raise ValueError(f"{self.name} holds NaN or infinity: {value}")
        return value

    def build(self) -> Any:
        widgets = require("ipywidgets", "lab")
        sliders = [
            _slider(label, self._shown(number), self.low, self.high, self.step, self.told)
            for label, number in zip(self.labels, self._value, strict=True)
        ]
        for index, slider in enumerate(sliders):
            slider.observe(lambda change, index=index: self._hear_one(index, change["new"]), "value")
        return widgets.VBox(sliders)

    def write(self, twin: Any) -> None:
        for slider, number in zip(twin.children, self._value, strict=True):
            slider.value = self._shown(number)

    def _shown(self, number: float) -> Real:
        """A slider ends at its range; the value itself may lie beyond."""
        return min(max(number, self.low), self.high)

    def _hear_one(self, index: int, number: float) -> None:
        self.hear((*self._value[:index], number, *self._value[index + 1 :]))


class Choice(Control):
    """One of some names."""

    def __init__(self, name: str, options: Sequence[str], value: str | None = None, told: str = ""):
        self.options = tuple(options)
        super().__init__(name, options[0] if value is None else value, told)

    def checked(self, value: Any) -> str:
        if value not in self.options:
            raise ValueError(f"{self.name} is one of {', '.join(self.options)}; got {value!r}")
        return value

    def build(self) -> Any:
        widgets = require("ipywidgets", "lab")
        twin = widgets.Dropdown(
            options=self.options,
            value=self._value,
            description=self.name,
            tooltip=self.told,
            layout={"width": SLIDER},
            style={"description_width": LABEL},
        )
        twin.observe(lambda change: self.hear(change["new"]), "value")
        return twin

    def write(self, twin: Any) -> None:
        twin.value = self._value


class Toggle(Control):
    """On or off."""

    def checked(self, value: Any) -> bool:
        return bool(value)

    def build(self) -> Any:
        widgets = require("ipywidgets", "lab")
        twin = widgets.Checkbox(
            value=self._value, description=self.name, tooltip=self.told, indent=False, layout={"width": NARROW}
        )
        twin.observe(lambda change: self.hear(change["new"]), "value")
        return twin

    def write(self, twin: Any) -> None:
        twin.value = self._value


@dataclass(frozen=True)
class Button:
    """Does something when pressed, such as setting other controls."""

    name: str
    press: Callable[[], None]
    told: str = ""

    def twin(self) -> Any:
        widgets = require("ipywidgets", "lab")
        twin = widgets.Button(description=self.name, tooltip=self.told, layout={"width": "auto"})
        twin.on_click(lambda _: self.press())
        return twin


@dataclass(frozen=True)
class Group:
    """Controls under a heading; `folded` ones open by a click."""

    title: str
    items: tuple[Control | Button, ...]
    folded: bool = False


def column(groups: Sequence[Group]) -> Any:
    """All groups below one another.  Raises MissingExtra without ipywidgets."""
    widgets = require("ipywidgets", "lab")
    parts = []
    for group in groups:
        buttons = [item.twin() for item in group.items if isinstance(item, Button)]
        rows = [item.twin() for item in group.items if isinstance(item, Control)]
        if buttons:
            rows.insert(0, widgets.HBox(buttons, layout=KEPT | {"flex_flow": "row wrap"}))
        inside = widgets.VBox(rows, layout=KEPT)
        if group.folded:
            parts.append(widgets.Accordion([inside], titles=(group.title,), selected_index=None, layout=KEPT))
        else:
            parts.append(widgets.VBox([widgets.HTML(f"<b>{group.title}</b>"), inside], layout=KEPT))
    return widgets.VBox(parts, layout={"width": "330px", "flex": "0 0 auto", "max_height": "640px", "overflow": "auto"})


def controls_of(groups: Sequence[Group]) -> dict[str, Control | Button]:
    """Every control and button by its name.  ValueError where two have one name."""
    found: dict[str, Control | Button] = {}
    for group in groups:
        for item in group.items:
            if item.name in found:
                raise ValueError(f"two controls are called {item.name!r}")
            found[item.name] = item
    return found


# the controls that many views share


def shape_sliders(count: int, value: Iterable[Real] = (), spread: Real = 3.0) -> Vector:
    """beta, in standard deviations."""
    given = (*value, *[0.0] * count)[:count]
    return Vector("beta", given, -spread, spread, 0.1, told="standard deviations from the mean person")


def latent_sliders(count: int, value: Iterable[Real] = (), spread: Real = 4.0) -> Vector:
    """x_bar, in standard deviations of the prior N(0, I)."""
    given = (*value, *[0.0] * count)[:count]
    labels = [f"latent {index + 1}" for index in range(count)]
    return Vector("latent", given, -spread, spread, 0.1, labels, "standard deviations; trained garments lie within 2")


def theta_sliders(value: Iterable[Real] = (0.0, 0.0, 0.0)) -> Vector:
    """theta of one joint: a rotation vector, degrees."""
    labels = ("theta x (deg)", "theta y (deg)", "theta z (deg)")
    return Vector("theta", value, -180.0, 180.0, 1.0, labels, "the joint's rotation vector, in degrees")


def frame_slider(frames: int, value: int = 0) -> Number:
    """Which frame of a sequence."""
    return Number("frame", value, 0, frames - 1, 1)


def seed_slider(value: int = 0, most: int = 99) -> Number:
    """Which random numbers."""
    return Number("seed", value, 0, most, 1, "the same seed gives the same random numbers")


def _slider(name: str, value: Real, low: Real, high: Real, step: Real, told: str) -> Any:
    widgets = require("ipywidgets", "lab")
    whole = isinstance(step, int)
    kind, digits = (widgets.IntSlider, "d") if whole else (widgets.FloatSlider, ".0f" if step >= 1 else ".2f")
    return kind(
        readout_format=digits,
        value=value,
        min=low,
        max=high,
        step=step,
        description=name,
        tooltip=told,
        layout={"width": SLIDER},
        style={"description_width": LABEL},
    )
