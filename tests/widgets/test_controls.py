"""Controls: a value and its twins agree, whoever moves them; values that cannot be had are told."""

import pytest

from widgets.controls import (
    Button,
    Choice,
    Group,
    Number,
    Toggle,
    Vector,
    column,
    controls_of,
    frame_slider,
    latent_sliders,
    shape_sliders,
    theta_sliders,
)

pytest.importorskip("ipywidgets")


def heard(control):
    """The values that listeners were told."""
    values = []
    control.listen(lambda: values.append(control.value))
    return values


def test_hand_and_program_move_the_same_value():
    number, choice, toggle = Number("t", 0.5, 0.0, 1.0), Choice("which", ("a", "b")), Toggle("on", False)
    moves = [(number, 0.25, 0.75), (choice, "b", "a"), (toggle, True, False)]
    for control, by_program, by_hand in moves:
        twin, values = control.twin(), heard(control)
        control.set(by_program)
        assert twin.value == by_program
        twin.value = by_hand
        assert control.value == by_hand
        assert values == [by_program, by_hand]


def test_every_slider_of_a_vector_moves_its_own_component():
    vector = Vector("x", [0.0] * 4, -1, 1)
    twin, values = vector.twin(), heard(vector)
    twin.children[2].value = 0.5
    assert vector.value == (0.0, 0.0, 0.5, 0.0)
    vector.set([0.1, 0.2, 0.3, 0.4])
    assert [slider.value for slider in twin.children] == [0.1, 0.2, 0.3, 0.4]
    assert len(values) == 2  # four sliders moved along: the listeners hear of it once


def test_a_vector_may_lie_beyond_its_sliders():
    vector = Vector("x", [0.0, 0.0], -1, 1)
    twin = vector.twin()
    vector.set([5.0, 0.5])
    assert vector.value == (5.0, 0.5)
    assert [slider.value for slider in twin.children] == [1.0, 0.5]
    assert vector.value == (5.0, 0.5)


def test_what_does_not_change_is_not_heard():
    number = frame_slider(5)
    values = heard(number)
    number.set(0)
    assert values == []
    number.set(3)
    number.reset()
    assert values == [3, 0]


@pytest.mark.parametrize(
    ("control", "value", "told"),
    [
        (Number("t", 0.0, 0.0, 1.0), 2.0, "t goes from 0 to 1, but got 2"),
        (frame_slider(5), 5, "frame goes from 0 to 4"),
        (shape_sliders(10), [0.0] * 9, "beta has 10 numbers, but got 9"),
        (latent_sliders(3), [0.0, float("nan"), 0.0], "latent holds NaN"),
        (theta_sliders(), [0.0], "theta has 3 numbers"),
        (Choice("which", ("a", "b")), "c", "which is one of a, b; got 'c'"),
    ],
)
def test_values_that_cannot_be_had_are_told(control, value, told):
    with pytest.raises(ValueError, match=told):
        control.set(value)
    assert control.value == control.start


def test_a_column_holds_every_control_and_buttons_press():
    pressed = []
    groups = (Group("one", (Button("go", lambda: pressed.append(1)), Number("t", 0.0, 0.0, 1.0))), Group("two", ()))
    made = column(groups)
    buttons = made.children[0].children[1].children[0].children
    buttons[0].click()
    assert pressed == [1]
    assert list(controls_of(groups)) == ["go", "t"]


def test_two_controls_of_one_name_are_refused():
    with pytest.raises(ValueError, match="two controls are called 'frame'"):
        controls_of((Group("", (frame_slider(2), frame_slider(3))),))
