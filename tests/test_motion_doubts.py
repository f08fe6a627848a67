"""What is told of poses that no body can take."""

import logging
import math

import torch

from workbench.formats import load_motion
from workbench.formats.bvh import write_bvh
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.motion_doubts import doubtful_spine


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
