"""Notes beside motion files."""

import json

import pytest
import torch

from workbench.body.skeleton import Skeleton
from workbench.formats import load_motion, motion_files
from workbench.formats.bvh import write_bvh
from workbench.formats.motion_notes import MotionNotes, notes_beside
from workbench.motion import Motion

ODD = {"LeftLeg": "KneeL", "Hips": "Basin"}


@pytest.fixture
def clip(body, tmp_path):
    """A motion that ships, its joints renamed to what no convention knows."""
    motion = load_motion(motion_files(None)[0], body).clip(0, 6)
    skeleton = motion.skeleton
    names = tuple(ODD.get(name, name) for name in skeleton.names)
    renamed = Skeleton(names, skeleton.parents, skeleton.rest_joints)
    write_bvh(tmp_path / "odd.bvh", Motion(motion.rotations, motion.translation, motion.fps, renamed, "odd"))
    return tmp_path / "odd.bvh"


def test_a_rig_of_no_convention_is_read_with_a_note(clip, body):
    with pytest.raises(ValueError, match=r'odd\.bvh.*for Hips, LeftLeg;.*write \{"joints".*motions\.notes\.json'):
        load_motion(clip, body)
    clip.with_name("motions.notes.json").write_text(json.dumps({"joints": ODD}))
    found = load_motion(clip, body)
    assert found.fps == pytest.approx(30.0, abs=1e-3)
    told = load_motion(clip, body, mapping=ODD)
    torch.testing.assert_close(found.rotations, told.rotations)


def test_the_note_of_a_clip_goes_before_that_of_its_folder_and_what_is_passed_before_both(clip, body):
    clip.with_name("motions.notes.json").write_text(json.dumps({"joints": ODD, "fps": 60}))
    clip.with_name("odd.bvh.notes.json").write_text('{"fps": 120}')
    assert notes_beside(clip) == MotionNotes(120.0, ODD)
    assert load_motion(clip, body).fps == 120
    assert load_motion(clip, body, fps=25.0).fps == 25


def test_a_folder_with_notes_is_a_folder_of_motions(clip):
    clip.with_name("motions.notes.json").write_text("{}")
    assert motion_files(clip.parent) == [clip]
    assert notes_beside(clip) == MotionNotes()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{", "not readable as JSON"),
        ("[" * 100_000, "not readable as JSON"),
        ("[]", "must be"),
        ('{"rate": 60}', "must be"),
        ('{"fps": "60"}', "fps must be a number above 0, got '60'"),
        ('{"fps": true}', "fps must be a number"),
        ('{"fps": -1}', "fps must be a number"),
        ('{"fps": 1' + "0" * 400 + "}", "fps must be a number"),
        ('{"fps": NaN}', "fps must be a number"),
        ('{"joints": ["Hips"]}', "joints must give a joint's name for each role"),
        ('{"joints": {"Hips": 3}}', "joints must give a joint's name"),
    ],
)
def test_notes_that_cannot_be_used_are_refused(clip, text, told):
    clip.with_name("motions.notes.json").write_text(text)
    with pytest.raises(ValueError, match=f"motions.notes.json.*{told}"):
        notes_beside(clip)
