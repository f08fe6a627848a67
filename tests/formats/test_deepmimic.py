"""DeepMimic's motions: what the numbers mean, and what is refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from workbench.body.skinning import forward_kinematics
from workbench.formats import load_motion, motion_files
from workbench.formats.deepmimic import WIDTH, humanoid, read_deepmimic

ROOT, HIP, KNEE, ELBOW = 4, 16, 20, 43  # columns


def standing(frames: int) -> np.ndarray:
    rows = np.zeros((frames, WIDTH))
    rows[:, 0], rows[:, 2] = 0.04, 0.9
    rows[:, [4, 8, 12, 16, 21, 25, 30, 35, 39]] = 1.0
    return rows


def written(path: Path, rows: np.ndarray) -> Path:
    path.write_text(json.dumps({"Loop": "wrap", "Frames": rows.tolist()}))
    return path


def places(path: Path) -> dict[str, torch.Tensor]:
    """Joint -> where it is, frames by axes (x forward, y up, z to the right)."""
    motion = read_deepmimic(path)
    skeleton = motion.skeleton
    found = forward_kinematics(motion.rotations, skeleton.rest_joints, skeleton.parents).joints
    found = found + motion.translation[:, None]
    return {name: found[:, k] for k, name in enumerate(skeleton.names)}


def test_a_frame_says_where_joints_are(tmp_path):
    rows = standing(3)
    rows[1, KNEE] = -math.pi / 2  # the shank back
    rows[1, ELBOW] = math.pi / 2  # the left forearm forward
    half = math.sqrt(0.5)
    rows[2, HIP : HIP + 4] = (half, 0, 0, half)  # a quarter about z: the right thigh forward
    at = places(written(tmp_path / "clip.txt", rows))
    torch.testing.assert_close(at["Hips"][0], torch.tensor([0.0, 0.9, 0.0]))
    shank = at["RightFoot"] - at["RightLeg"]
    torch.testing.assert_close(shank[0], torch.tensor([0.0, -0.41, 0.0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(shank[1], torch.tensor([-0.41, 0.0, 0.0]), atol=1e-5, rtol=0)
    forearm = at["LeftHand"] - at["LeftForeArm"]
    torch.testing.assert_close(forearm[1], torch.tensor([0.259, 0.0, 0.0]), atol=1e-5, rtol=0)
    thigh = at["RightLeg"] - at["RightUpLeg"]
    torch.testing.assert_close(thigh[2], torch.tensor([0.422, 0.0, 0.0]), atol=1e-5, rtol=0)
    assert (at["RightArm"][:, 2] > 0).all() and (at["LeftArm"][:, 2] < 0).all()


def test_the_length_of_a_quaternion_says_nothing(tmp_path):
    rows = standing(2)
    rows[:, HIP : HIP + 4] = (0.8, 0.0, 0.0, 0.6)
    one = read_deepmimic(written(tmp_path / "one.txt", rows))
    rows[:, HIP : HIP + 4] *= 0.58
    torch.testing.assert_close(read_deepmimic(written(tmp_path / "two.txt", rows)).rotations, one.rotations)


def test_frames_of_unequal_duration_are_brought_onto_even_times(tmp_path):
    """A root that moves at constant speed and turns at constant rate does so still."""
    rows = standing(9)
    rows[[2, 5], 0] = 0.08
    starts = np.concatenate([[0.0], np.cumsum(rows[:-1, 0])])
    rows[:, 1] = 0.5 * starts
    rows[:, ROOT], rows[:, ROOT + 2] = np.cos(starts), np.sin(starts)  # about y
    motion = read_deepmimic(written(tmp_path / "clip.txt", rows))
    assert motion.fps == pytest.approx(25.0)
    assert motion.duration == pytest.approx(starts[-1])
    times = torch.arange(len(motion)) / motion.fps
    torch.testing.assert_close(motion.translation[:, 0], 0.5 * times, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(motion.rotations[:, 0, 0, 0], torch.cos(2 * times), atol=1e-5, rtol=1e-5)
    assert len(read_deepmimic(tmp_path / "clip.txt", fps=60.0)) == 9


def test_it_stands_upright_and_faces_forward_on_the_body(tmp_path, body):
    motion = load_motion(written(tmp_path / "clip.txt", standing(2)), body)
    vertices = body.vertices(motion.rotations[:1], body.mean_shape(), motion.translation[:1])[0]
    assert float(vertices[:, 2].min()) == pytest.approx(0.0, abs=0.01)
    assert float(vertices[:, 2].max()) > 1.4
    joints = forward_kinematics(motion.rotations[0], body.joints(body.mean_shape()), body.parents).joints
    at = dict(zip(body.joint_names, joints, strict=True))
    assert at["LeftToeBase"][1] < at["LeftFoot"][1] - 0.05  # facing -y
    assert at["LeftFoot"][0] > at["RightFoot"][0]
    for side in ("Left", "Right"):  # arms hang
        assert at[f"{side}Hand"][2] < at[f"{side}Arm"][2] - 0.4


def test_other_text_in_a_folder_is_no_motion(tmp_path):
    written(tmp_path / "clip.txt", standing(2))
    (tmp_path / "README.txt").write_text("Clips of ours.")
    assert [path.name for path in motion_files(tmp_path)] == ["clip.txt"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows[:, :30], r"frames of 44 numbers, but these are \(4, 30\)"),
        (lambda rows: rows[:0], "frames of 44 numbers"),
        (lambda rows: np.where(np.arange(WIDTH) == 7, np.nan, rows), "frame 0 holds NaN"),
        (lambda rows: np.where(np.arange(WIDTH) == 4, 0.0, rows), "the rotation of Hips in frame 0 is no quaternion"),
        (lambda rows: np.where(np.arange(WIDTH) == 0, 0.0, rows), r"its frames last 0 to 0 s; .*\(fps\)"),
        (lambda rows: rows * np.array([[1.0], [900.0], [1.0], [1.0]]), "its frames last 0.04 to 36 s"),
    ],
)
def test_bad_numbers_are_told(tmp_path, change, said):
    path = written(tmp_path / "clip.txt", change(standing(4)))
    with pytest.raises(ValueError, match=rf"clip.txt: .*{said}"):
        read_deepmimic(path)


def test_files_of_another_kind_are_told(tmp_path):
    path = tmp_path / "clip.txt"
    for text in ('{"Frames": [[0.1', '{"frames": []}', "a readme", '{"Frames": [["a"]]}', "[" * 100_000):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"clip.txt is not readable as a motion of DeepMimic \(truncated"):
            read_deepmimic(path)
    with pytest.raises(FileNotFoundError, match="no motion file at"):
        read_deepmimic(tmp_path / "none.txt")


def test_the_rest_pose_is_symmetric():
    skeleton = humanoid()
    for name in skeleton.names:
        other = name.replace("Right", "Left")
        mirrored = skeleton.rest_joints[skeleton.index(name)] * torch.tensor([1.0, 1.0, -1.0 if other != name else 1.0])
        torch.testing.assert_close(skeleton.rest_joints[skeleton.index(other)], mirrored)
