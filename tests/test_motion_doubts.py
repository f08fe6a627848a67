"""What is told of poses that no body can take."""

import logging
import math

import pytest
import torch

from workbench.formats import load_motion
from workbench.formats.bvh import write_bvh
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.motion_doubts import doubtful_spine, mended


def folded(body, angles) -> Motion:
    """One frame for each angle [degrees] of the lower back, about the same axis."""
    rotations = body.rest_rotations()[None].repeat(len(angles), 1, 1, 1)
    vectors = torch.tensor([[math.radians(a), 0.0, 0.0] for a in angles])
    rotations[:, body.skeleton.index("LowerBack")] = axis_angle_to_matrix(vectors)
    return Motion(rotations, torch.zeros(len(angles), 3), 30.0, body.skeleton, "folded")


def test_a_spine_that_no_one_has_is_told_with_its_frames(body):
    assert doubtful_spine(folded(body, [0.0, 60.0, -90.0])) is None
    told = doubtful_spine(folded(body, [0, 120, 130, 0, 110, 0, 110, 0, 110]))
    assert told == ("LowerBack is turned by up to 130 degrees in frames 1-2, 4, 6, ... of 9: an error of the capture?")


def test_who_loads_such_a_clip_is_warned_and_gets_it(body, tmp_path, caplog):
    motion = folded(body, [0.0] * 5 + [125.0])
    write_bvh(tmp_path / "flip.bvh", motion)
    with caplog.at_level(logging.WARNING):
        found = load_motion(tmp_path / "flip.bvh", body)
    assert len(found) == 6
    assert "flip.bvh: LowerBack is turned by up to 125 degrees in frames 5 of 6" in caplog.text


def test_frames_of_an_error_are_bridged_and_all_others_stay(body):
    """10 degrees, an error that comes and goes, 40 degrees: a constant turn between them."""
    motion = folded(body, [10, 10, 75, 140, 90, 40, 40, 80, 40])
    path = torch.arange(9.0)[:, None] * torch.tensor([0.1, 0.0, 0.0])
    path[3] += 5.0
    motion = Motion(motion.rotations, path, 30.0, body.skeleton, "folded")
    bridged = mended(motion)
    expected = folded(body, [10, 10, 17.5, 25, 32.5, 40, 40, 80, 40])  # 80 is much, but no error begins it
    torch.testing.assert_close(bridged.rotations, expected.rotations, atol=1e-5, rtol=0)
    torch.testing.assert_close(bridged.translation[:, 0], torch.arange(9) * 0.1)
    assert bridged.rotations[[0, 1, 5, 6, 7, 8]].equal(motion.rotations[[0, 1, 5, 6, 7, 8]])
    whole = folded(body, [0, 50, 90])
    assert mended(whole) is whole


def test_an_error_at_an_end_takes_the_pose_next_to_it(body):
    bridged = mended(folded(body, [120, 120, 30, 20, 110]))
    torch.testing.assert_close(bridged.rotations, folded(body, [30, 30, 30, 20, 20]).rotations, atol=1e-5, rtol=0)
    alone = mended(folded(body, [120, 30, 120]))
    torch.testing.assert_close(alone.rotations, folded(body, [30, 30, 30]).rotations, atol=1e-5, rtol=0)


def test_what_cannot_be_bridged_is_told(body, caplog):
    with pytest.raises(ValueError, match="'folded': every frame has a spine that no one has"):
        mended(folded(body, [120, 130]))
    long = folded(body, [0] + [120] * 40 + [0] * 3 + [120, 0])
    with caplog.at_level(logging.WARNING):
        found = mended(long)
    assert "frames 1-40 are too many to bridge" in caplog.text
    assert doubtful_spine(found) == doubtful_spine(long).replace(", 44", "")  # pyright: ignore[reportOptionalMemberAccess]
