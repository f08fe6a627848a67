"""AMASS: every pose width is read, the world stays as it is, and what is damaged is refused."""

import numpy as np
import pytest
import torch

from workbench.body.skinning import forward_kinematics
from workbench.formats.amass import POSE_WIDTHS, read_amass, smpl_t_pose
from workbench.geometry.rotations import axis_angle_to_matrix


def arrays(frames=6, width=156, seed=0):
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(frames, width)) * 0.3
    poses[:, :3] = [np.pi / 2, 0, 0]  # stands up in AMASS' world
    return {
        "poses": poses,
        "trans": rng.normal(size=(frames, 3)),
        "mocap_framerate": np.array(120.0),
        "betas": rng.normal(size=16),
        "gender": np.array("female"),
        "dmpls": np.zeros((frames, 8)),
    }


def write(tmp_path, content, name="walk.npz"):
    np.savez(tmp_path / name, **content)
    return tmp_path / name


@pytest.mark.parametrize("width", POSE_WIDTHS)
def test_all_widths_hold_the_same_body(tmp_path, width):
    full = arrays()
    motion = read_amass(write(tmp_path, full | {"poses": np.pad(full["poses"], ((0, 0), (0, 9)))[:, :width]}))
    reference = read_amass(write(tmp_path, full))
    assert torch.equal(motion.rotations, reference.rotations)
    assert (len(motion), len(motion.skeleton), motion.fps) == (6, 22, 120.0)


def test_joints_are_where_smpl_puts_them(tmp_path):
    """The skeleton is turned to z up, the world is AMASS' own: the same joints as posing the y-up skeleton."""
    content = arrays()
    motion = read_amass(write(tmp_path, content))
    rest = smpl_t_pose()
    local = axis_angle_to_matrix(torch.from_numpy(content["poses"][:, :66]).unflatten(1, (22, 3)))
    expected = forward_kinematics(local.float(), rest.rest_joints, rest.parents).joints
    expected = expected + torch.from_numpy(content["trans"])[:, None].float()
    ours = forward_kinematics(motion.rotations, motion.skeleton.rest_joints, motion.skeleton.parents).joints
    torch.testing.assert_close(ours + motion.translation[:, None], expected, rtol=0, atol=1e-5)


def test_rest_pose_stands_and_faces_forward(tmp_path):
    still = arrays() | {"poses": np.tile(np.r_[np.pi / 2, np.zeros(65)], (6, 1))}
    motion = read_amass(write(tmp_path, still))
    rest = motion.skeleton.rest_joints
    torch.testing.assert_close(motion.rotations, torch.eye(3).expand_as(motion.rotations), rtol=0, atol=1e-6)
    at = motion.skeleton.index
    assert rest[at("head"), 2] > rest[at("pelvis"), 2] > rest[at("left_ankle"), 2]
    assert rest[at("left_wrist"), 0] > 0 > rest[at("right_wrist"), 0]
    assert rest[at("left_foot"), 1] < rest[at("left_ankle"), 1]


def test_other_layouts_of_the_same_poses(tmp_path):
    content = arrays()
    reference = read_amass(write(tmp_path, content))
    stacked = content | {"poses": content["poses"].reshape(6, 52, 3)}
    split = {key: value for key, value in content.items() if key != "poses"}
    split |= {"root_orient": content["poses"][:, :3], "pose_body": content["poses"][:, 3:66]}
    renamed = {key: value for key, value in content.items() if key != "mocap_framerate"}
    renamed |= {"mocap_frame_rate": np.array(120)}
    for other in (stacked, split, renamed):
        motion = read_amass(write(tmp_path, other))
        assert torch.equal(motion.rotations, reference.rotations)
        assert motion.fps == 120.0


def test_arrays_of_objects_are_left_alone(tmp_path):
    """Marker labels of some files are Python objects: they are neither needed nor unpickled."""
    content = arrays() | {"labels_obs": np.array([["a"], ["b", "c"]], dtype=object)}
    assert len(read_amass(write(tmp_path, content))) == 6


def test_the_rate_can_be_overridden(tmp_path):
    content = arrays()
    assert read_amass(write(tmp_path, content), fps=60.0).fps == 60.0
    del content["mocap_framerate"]
    assert read_amass(write(tmp_path, content), fps=60.0).fps == 60.0
    with pytest.raises(ValueError, match=r"walk\.npz says no frame rate.*pass fps"):
        read_amass(write(tmp_path, content))


def with_nan(key):
    content = arrays()
    content[key][4, 1] = np.nan
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (with_nan("poses"), "poses must be finite, but frame 4"),
        (with_nan("trans"), "trans must be finite, but frame 4"),
        (arrays(width=63), r"poses must be \(T, W\).*66 \(body only\).*\(6, 63\)"),
        (arrays() | {"poses": np.zeros(66)}, "poses must be"),
        (arrays() | {"poses": np.array(["a"] * 6)}, "poses must hold numbers"),
        (arrays() | {"poses": np.zeros((5, 66))}, "poses have 5 frames, but trans has 6"),
        (arrays() | {"trans": np.zeros((6, 2))}, r"trans must be \(T, 3\)"),
        (arrays(frames=0), "at least one frame"),
        (arrays() | {"mocap_framerate": np.array(0.0)}, "mocap_framerate must be a number above 0"),
        (arrays() | {"mocap_framerate": np.array([1.0, 2.0])}, "mocap_framerate must be one number"),
        ({"betas": np.zeros(16), "gender": np.array("male")}, "holds no motion.*but betas, gender"),
        ({key: value for key, value in arrays().items() if key != "trans"}, "lacks trans"),
    ],
)
def test_damaged_files_are_refused(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"bad\.npz.*{message}"):
        read_amass(write(tmp_path, content, "bad.npz"))


@pytest.mark.parametrize("keep", [0, 3, 200, 2000])
def test_truncated_files_are_named(tmp_path, keep):
    whole = write(tmp_path, arrays()).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[:keep])
    with pytest.raises(ValueError, match=r"cut\.npz is not readable"):
        read_amass(tmp_path / "cut.npz")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.npz"):
        read_amass(tmp_path / "nothing.npz")
