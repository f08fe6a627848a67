"""Units, axes, holes and normals of foreign meshes: each doubt is one line with the flags that mend it, and they do."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from workbench.collisions.conventions import (
    METRES,
    UPRIGHT,
    Convention,
    check_size,
    check_together,
    closed_outwards,
    converted,
    doubtful_up,
)
from workbench.formats.mesh_sequence import MeshSequence
from workbench.garments import Garment

NOTHING = Convention()


@pytest.fixture(scope="module")
def person(body) -> MeshSequence:
    return MeshSequence(body.template[None].numpy(), body.faces.numpy(), 30.0, "body")


@pytest.fixture(scope="module")
def shirt() -> MeshSequence:
    garment = Garment.load("tshirt")
    return MeshSequence(garment.vertices[None].numpy(), garment.faces.numpy(), 30.0, "garment")


def written_as(sequence: MeshSequence, unit, up) -> MeshSequence:
    """The same in another unit and with another axis up: the inverse of `converted`."""
    theirs = sequence.vertices @ UPRIGHT[up] / METRES[unit]
    return replace(sequence, vertices=theirs.astype(np.float32))


def flags(error: ValueError) -> dict[str, str]:
    return dict(re.findall(r"--([a-z-]+) (\S+?)(?=[ ,)]|$)", str(error)))


@pytest.mark.parametrize("up", UPRIGHT)
@pytest.mark.parametrize("unit", METRES)
def test_conversion_undoes_any_unit_and_axis(shirt, unit, up):
    again = converted(written_as(shirt, unit, up), Convention(unit, up))
    np.testing.assert_allclose(again.vertices, shirt.vertices, atol=1e-5)


@pytest.mark.parametrize("up", UPRIGHT)
def test_no_axis_mirrors(up):
    assert np.linalg.det(UPRIGHT[up]) == pytest.approx(1)
    axis = {"x": 0, "y": 1, "z": 2}[up[-1]]
    theirs = np.zeros(3)
    theirs[axis] = -1 if up.startswith("-") else 1
    np.testing.assert_allclose(UPRIGHT[up] @ theirs, [0, 0, 1])


def test_what_fits_is_not_doubted(person, shirt):
    check_size(person, NOTHING)
    check_together(person, shirt, NOTHING)
    assert doubtful_up(person) is None
    assert converted(person, NOTHING) is person


@pytest.mark.parametrize("unit", ["cm", "mm"])
def test_a_body_in_another_unit_is_told_and_the_flag_mends_it(person, unit):
    other = written_as(person, unit, "z")
    with pytest.raises(ValueError, match=f"it looks like {unit}; add --body-unit {unit}") as told:
        check_size(other, NOTHING)
    assert flags(told.value)["body-unit"] == unit
    mended = Convention(unit=unit)
    check_size(converted(other, mended), mended)


def test_a_body_of_no_size_is_refused_but_can_be_taken(person):
    giant = replace(person, vertices=person.vertices * 10)
    with pytest.raises(ValueError, match=r"the body is 1\d\.\d units long, which is no person in m, cm or mm"):
        check_size(giant, NOTHING)
    check_size(giant, Convention(unit="m"))


@pytest.mark.parametrize(("unit", "up"), [("cm", "z"), ("mm", "z"), ("m", "y"), ("cm", "y"), ("mm", "-y"), ("m", "x")])
def test_a_garment_in_other_conventions_is_told_and_the_flags_put_it_on(person, shirt, unit, up):
    other = written_as(shirt, unit, up)
    with pytest.raises(
        ValueError, match="half of the garment is more than .* m away from the body, and it is .* of its size"
    ) as told:
        check_together(person, other, NOTHING)
    proposed = flags(told.value)
    convention = Convention(proposed.get("garment-unit", "m"), proposed.get("garment-up", "z"))  # pyright: ignore[reportArgumentType]
    assert (convention.unit, convention.up) == (unit, up)
    np.testing.assert_allclose(converted(other, convention).vertices, shirt.vertices, atol=1e-5)


def test_a_garment_of_another_place_is_told_but_can_be_taken(person, shirt):
    away = replace(shirt, vertices=shirt.vertices + np.array([5, 0, 0], np.float32))
    with pytest.raises(ValueError, match="no unit .* or up axis puts it on"):
        check_together(person, away, NOTHING)
    check_together(person, away, Convention(unit="m"))


@pytest.mark.parametrize("up", ["y", "x"])
def test_a_body_that_lies_is_noticed(person, up):
    assert doubtful_up(written_as(person, "m", up)) == up


# --- open and inside-out bodies


def test_a_closed_body_is_left_alone(person):
    assert closed_outwards(person, fill_holes=False, flip=False) is person


def test_an_open_body_is_told_and_can_be_closed():
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.asarray(ball.vertices, np.float32)
    keep = np.abs(vertices[ball.faces][:, :, 2].mean(1)) < 0.8
    open_ball = MeshSequence(np.stack([vertices, vertices + 1]), np.asarray(ball.faces)[keep], 30.0, "body")
    with pytest.raises(ValueError, match=r"the body is open: 2 holes, the largest of \d+ edges.*add --fill-holes"):
        closed_outwards(open_ball, fill_holes=False, flip=False)
    mended = closed_outwards(open_ball, fill_holes=True, flip=False)
    assert mended.vertices.shape == (2, len(vertices) + 2, 3)
    for frame in mended.vertices:
        closed = trimesh.Trimesh(frame, mended.faces, process=False)
        assert closed.is_watertight
        assert closed.is_winding_consistent
        assert 0.8 * ball.volume < closed.volume < ball.volume
    np.testing.assert_allclose(mended.vertices[1] - mended.vertices[0], 1, atol=1e-6)


def test_an_inside_out_body_is_told_and_can_be_turned(person):
    turned = replace(person, faces=person.faces[:, ::-1].copy())
    with pytest.raises(ValueError, match="the body is inside out: the normals point inwards.*add --flip-body"):
        closed_outwards(turned, fill_holes=False, flip=False)
    np.testing.assert_array_equal(closed_outwards(turned, fill_holes=False, flip=True).faces, person.faces)


def test_one_part_inside_out_is_told_and_turned_alone():
    box = trimesh.creation.box()
    vertices, faces = np.asarray(box.vertices, np.float32), np.asarray(box.faces)
    both = MeshSequence(
        np.concatenate([vertices, vertices + 3])[None], np.concatenate([faces, faces[:, ::-1] + 8]), 30.0, "body"
    )
    with pytest.raises(ValueError, match="1 of the body's 2 parts are inside out"):
        closed_outwards(both, fill_holes=False, flip=False)
    mended = closed_outwards(both, fill_holes=False, flip=True)
    np.testing.assert_array_equal(mended.faces, np.concatenate([faces, faces + 8]))


def test_faces_that_disagree_are_refused(person):
    torn = person.faces.copy()
    torn[5] = torn[5, ::-1]
    with pytest.raises(ValueError, match="orient its faces"):
        closed_outwards(replace(person, faces=torn), fill_holes=False, flip=True)
    with pytest.raises(ValueError, match="orient its faces"):
        closed_outwards(replace(person, faces=torn[:-1]), fill_holes=True, flip=True)
