"""BVH: what is written is read back, however it is laid out; what is damaged is refused with file and line."""

import logging

import numpy as np
import pytest
import torch

from workbench.body.skeleton import Skeleton
from workbench.body.skinning import forward_kinematics
from workbench.formats.bvh import END_SITE, read_bvh, write_bvh
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion

TREE = Skeleton(
    ("Hips", "Spine", "Head", "Head" + END_SITE, "Left Leg", "Left Leg" + END_SITE),
    (-1, 0, 1, 2, 0, 4),
    torch.tensor([[0.0, 0.1, 0.9], [0.0, 0.1, 1.2], [0.0, 0.0, 1.5], [0, 0, 1.7], [0.1, 0.1, 0.85], [0.12, 0.1, 0.02]]),
)


def tumbling(frames=7, fps=60.0):
    generator = torch.Generator().manual_seed(1)
    angles = 3 * (torch.rand(frames, 6, 3, generator=generator) - 0.5)
    angles[:, [3, 5]] = 0  # end sites never turn
    return Motion(axis_angle_to_matrix(angles), torch.rand(frames, 3, generator=generator), fps, TREE, name="tumbling")


def joint_places(motion):
    pose = forward_kinematics(motion.rotations, motion.skeleton.rest_joints, motion.skeleton.parents)
    return pose.joints + motion.translation[:, None]


@pytest.mark.parametrize("order", ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"])
def test_round_trip_in_every_channel_order(tmp_path, order):
    motion = tumbling()
    write_bvh(tmp_path / "tumbling.bvh", motion, order=order, up="z", units_per_metre=1.0)
    back = read_bvh(tmp_path / "tumbling.bvh")
    torch.testing.assert_close(back.rotations, motion.rotations, rtol=0, atol=1e-5)
    torch.testing.assert_close(back.translation, motion.translation, rtol=0, atol=1e-5)
    torch.testing.assert_close(back.skeleton.rest_joints, motion.skeleton.rest_joints, rtol=0, atol=1e-6)
    assert back.skeleton.same_tree(motion.skeleton)
    assert (back.fps, back.name) == (60.0, "tumbling")


def test_y_up_and_centimetres_turn_the_world_and_nothing_else(tmp_path):
    motion = tumbling()
    write_bvh(tmp_path / "m.bvh", motion)
    x, y, z = joint_places(read_bvh(tmp_path / "m.bvh")).unbind(-1)
    torch.testing.assert_close(torch.stack([x, -z, y], -1) / 100, joint_places(motion), rtol=0, atol=1e-5)


def test_a_skeleton_without_end_sites_gets_them_and_keeps_its_motion(tmp_path):
    bare = Motion(
        tumbling().rotations[:, [0, 1, 2, 4]],
        tumbling().translation,
        30.0,
        Skeleton(("Hips", "Spine", "Head", "Leg"), (-1, 0, 1, 0), TREE.rest_joints[[0, 1, 2, 4]]),
    )
    write_bvh(tmp_path / "m.bvh", bare, up="z", units_per_metre=1.0)
    back = read_bvh(tmp_path / "m.bvh")
    kept = [back.skeleton.index(name) for name in bare.skeleton.names]
    torch.testing.assert_close(joint_places(back)[:, kept], joint_places(bare), rtol=0, atol=1e-5)


def test_the_writer_orders_values_as_joints_are_written(tmp_path):
    """Joints of a Motion need not be depth first; a BVH file's are."""
    shuffled = [0, 4, 1, 5, 2, 3]
    motion = tumbling()
    tree = Skeleton(
        tuple(TREE.names[j] for j in shuffled),
        tuple(-1 if TREE.parents[j] < 0 else shuffled.index(TREE.parents[j]) for j in shuffled),
        TREE.rest_joints[shuffled],
    )
    write_bvh(tmp_path / "m.bvh", Motion(motion.rotations[:, shuffled], motion.translation, 60.0, tree), up="z")
    back = read_bvh(tmp_path / "m.bvh")
    kept = [back.skeleton.index(name) for name in TREE.names]
    torch.testing.assert_close(joint_places(back)[:, kept] / 100, joint_places(motion), rtol=0, atol=1e-5)


HAND_WRITTEN = """HIERARCHY
ROOT hip
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT knee
  {
    OFFSET 0 -4 0
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 0 -3 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
1 2 3 90 0 0 0 0 0
4 5 6 0 0 90 0 0 90
"""


def write(tmp_path, text, name="clip.bvh"):
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_known_angles_put_the_foot_where_it_belongs(tmp_path):
    motion = read_bvh(write(tmp_path, HAND_WRITTEN))
    feet = joint_places(motion)[:, 2]
    # frame 0: 90 degrees about z take -y to +x
    # frame 1: the knee's 90 degrees about x take -y to -z, the hip's about y take that to -x
    torch.testing.assert_close(feet, torch.tensor([[8.0, 2, 3], [1.0, 1, 6]]), rtol=0, atol=1e-5)
    assert motion.fps == 30.0


@pytest.mark.parametrize(
    "layout",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("hip\n{", "hip {").replace("Site\n    {\n ", "Site {"),
        lambda text: text.replace("  ", "\t"),
        lambda text: text.replace("Frames: 2", "Frames:\t2").replace("Frame Time: ", "Frame Time:"),
        lambda text: text.replace("MOTION", "\nMOTION\n").replace("3 90 0", "3   9e1\t0.0"),
        lambda text: text.replace("rotation", "Rotation").replace("position", "Position"),
        lambda text: text.rstrip("\n"),
    ],
)
def test_layout_does_not_matter(tmp_path, layout):
    plain, other = read_bvh(write(tmp_path, HAND_WRITTEN)), read_bvh(write(tmp_path, layout(HAND_WRITTEN), "other.bvh"))
    assert torch.equal(plain.rotations, other.rotations)
    assert torch.equal(plain.translation, other.translation)
    assert plain.skeleton.names == other.skeleton.names


def test_positions_of_inner_joints_may_stand_still(tmp_path, caplog):
    six = HAND_WRITTEN.replace("CHANNELS 3 Y", "CHANNELS 6 Xposition Yposition Zposition Y")
    six = six.replace("0 0 0\n4", "0 -4 0 0 0 0\n4").replace("90 0 0 90\n", "90 0 -4 0 0 0 90\n")
    plain, moved = read_bvh(write(tmp_path, HAND_WRITTEN)), read_bvh(write(tmp_path, six, "six.bvh"))
    assert torch.equal(plain.rotations, moved.rotations)
    assert not caplog.records


def test_positions_of_inner_joints_that_move_are_reported(tmp_path, caplog):
    text = HAND_WRITTEN.replace("  JOINT knee", "  JOINT tail\n  {\n  OFFSET 1 0 0\n  CHANNELS 0\n  }\n  JOINT knee")
    text = text.replace("CHANNELS 3 Y", "CHANNELS 6 Xposition Yposition Zposition Y")
    text = text.replace("0 0 0\n4", "0 -4 0 0 0 0\n4").replace("90 0 0 90\n", "90 1 -5 0 0 0 90\n")
    with caplog.at_level(logging.WARNING):
        read_bvh(write(tmp_path, text))
    assert "positions of 1 joints differ from their OFFSETs (knee)" in caplog.text


def test_a_reference_joint_above_the_hips_becomes_one_with_them(tmp_path):
    text = HAND_WRITTEN.replace(
        "ROOT hip", "ROOT reference\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\nJOINT hip"
    )
    text = (
        text.replace("\nMOTION", "\n}\nMOTION").replace("\n1 2 3", "\n0 0 0 1 2 3").replace("\n4 5 6", "\n0 0 0 4 5 6")
    )
    plain, below = read_bvh(write(tmp_path, HAND_WRITTEN)), read_bvh(write(tmp_path, text, "reference.bvh"))
    assert below.skeleton.names == plain.skeleton.names
    torch.testing.assert_close(joint_places(below), joint_places(plain))
    turned = read_bvh(write(tmp_path, text.replace("\n0 0 0 1", "\n90 0 0 1"), "turned.bvh"))
    x, y, z = joint_places(plain)[0].unbind(-1)
    torch.testing.assert_close(joint_places(turned)[0], torch.stack([x, -z, y], -1), rtol=0, atol=1e-5)


def test_the_rate_can_be_overridden(tmp_path):
    assert read_bvh(write(tmp_path, HAND_WRITTEN), fps=60.0).fps == 60.0
    assert read_bvh(write(tmp_path, HAND_WRITTEN.replace("0.0333333", "0")), fps=60.0).fps == 60.0
    with pytest.raises(ValueError, match="fps must be a number above 0"):
        read_bvh(write(tmp_path, HAND_WRITTEN), fps=-1.0)


@pytest.mark.parametrize(
    ("printed", "fps"), [(".0083333", 120.0), ("0.00833333", 120.0), ("0.04", 25.0), ("0.0334", 1 / 0.0334)]
)
def test_short_frame_times_mean_whole_rates(tmp_path, printed, fps):
    assert read_bvh(write(tmp_path, HAND_WRITTEN.replace("0.0333333", printed))).fps == pytest.approx(fps, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: "", "line 1: a BVH file starts with HIERARCHY"),
        (lambda t: "# Blender OBJ\nv 0 0 0\n", "line 1: a BVH file starts with HIERARCHY"),
        (lambda t: np.random.default_rng(0).bytes(4000), "starts with HIERARCHY"),
        (lambda t: t.split("MOTION")[0], "without a MOTION section; it is truncated"),
        (lambda t: t.replace("}\nMOTION", "MOTION"), "block of joint 'hip' is never closed"),
        (lambda t: t.split("\n90")[0].split("1 2 3")[0], "line 18: the file says Frames: 2, but has 0 lines"),
        (lambda t: t.split("4 5 6")[0], "line 19: the file says Frames: 2, but has 1 lines of values; it is truncated"),
        (lambda t: t[:-12], "line 20: a frame has one value for each of the 9 channels, but this has .*truncated"),
        (lambda t: t.replace("1 2 3", "1 2"), "line 19: a frame has one value for each of the 9 channels, .*has 8"),
        (lambda t: t.replace("1 2 3", "1 2 3 4"), "line 19: .*9 channels, but this has 10"),
        (lambda t: t + "0 0 0 0 0 0 0 0 0\n", "line 21: the file says Frames: 2, but has 3 lines"),
        (lambda t: t.replace("4 5 6", "4 nan 6"), "line 20: channel values must be finite"),
        (lambda t: t.replace("4 5 6", "4 inf 6"), "line 20: channel values must be finite"),
        (lambda t: t.replace("4 5 6", "4 five 6"), "line 20: channel values must be numbers, but got 'five'"),
        (lambda t: t.replace("Frames: 2", "Frames: 0"), "line 17: a motion needs at least one frame"),
        (lambda t: t.replace("Frames: 2", "Frames: many"), "line 17: .*'many'"),
        (lambda t: t.replace("Frames: 2\n", ""), "line 17: expected 'Frames'"),
        (lambda t: t.replace("0.0333333", "0"), "line 18: Frame Time must be .*pass fps"),
        (lambda t: t.replace("0.0333333", "fast"), "line 18: Frame Time must be"),
        (lambda t: t.replace("OFFSET 0 -4 0", "OFFSET 0 -4"), "line 8: OFFSET needs 3 numbers, but has 2"),
        (lambda t: t.replace("OFFSET 0 -4 0", "OFFSET 0 nan 0"), "line 8: an OFFSET must be finite"),
        (lambda t: t.replace("    OFFSET 0 -4 0\n", ""), "line 6: joint 'knee' has no OFFSET"),
        (lambda t: t.replace("CHANNELS 3 Y", "CHANNELS 3 Q"), "line 9: CHANNELS needs a count"),
        (lambda t: t.replace("CHANNELS 3 Yrot", "CHANNELS 4 Yrot"), "line 9: CHANNELS needs a count"),
        (lambda t: t.replace("JOINT knee", "JOINT hip"), "line 6: two joints are called 'hip'"),
        (lambda t: t.replace("JOINT knee", "JOINT"), "line 6: JOINT needs a name"),
        (lambda t: t.replace("JOINT knee", "ROOT knee"), "line 6: a BVH file has one ROOT"),
        (lambda t: t.replace("JOINT knee\n  {", "JOINT knee\n"), "line 8: expected '{' after joint 'knee'"),
        (lambda t: t.replace("OFFSET 0 -4 0", "SCALE 0 -4 0"), "line 8: 'SCALE' is not expected"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused_with_file_and_line(tmp_path, change, message):
    path = write(tmp_path, change(HAND_WRITTEN), "bad.bvh")
    with pytest.raises(ValueError, match=r"bad\.bvh, line .*") as caught:
        read_bvh(path)
    assert "\n" not in str(caught.value)
    caught.match(message)


def test_no_cut_of_a_file_passes_as_whole(tmp_path, rng):
    write_bvh(tmp_path / "m.bvh", tumbling())
    whole = (tmp_path / "m.bvh").read_bytes()
    last_value = whole.rstrip().rfind(b" ")
    for length in rng.integers(0, last_value, size=60):
        with pytest.raises(ValueError, match=r"cut\.bvh, line \d+"):
            read_bvh(write(tmp_path, whole[:length], "cut.bvh"))


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.bvh"):
        read_bvh(tmp_path / "nothing.bvh")


def test_names_that_would_break_the_file_are_refused(tmp_path):
    odd = Skeleton(("hip{", "knee"), (-1, 0), torch.tensor([[0.0, 0, 0], [0, 0, 1]]))
    with pytest.raises(ValueError, match="without braces"):
        write_bvh(tmp_path / "m.bvh", Motion(torch.eye(3).repeat(1, 2, 1, 1), torch.zeros(1, 3), 30.0, odd))
    assert not (tmp_path / "m.bvh").exists()
