"""Motions: resampling laws, clips, the round trip through a file, and what is refused."""

import numpy as np
import pytest
import torch

from workbench.body.skeleton import Skeleton
from workbench.geometry.rotations import axis_angle_to_matrix, rotation_angle
from workbench.motion import Motion

CHAIN = Skeleton(("root", "arm", "hand"), (-1, 0, 1), torch.tensor([[0.0, 0.0, 1.0], [0.2, 0.0, 1.3], [0.5, 0.0, 1.3]]))


def smooth_motion(frames=41, fps=30.0, seed=3):
    generator = torch.Generator().manual_seed(seed)
    phase = torch.linspace(0, 3, frames, dtype=torch.float64)[:, None, None]
    speed = 1 + torch.rand(1, 3, 3, generator=generator, dtype=torch.float64)
    angles = torch.sin(phase * speed)
    return Motion(
        axis_angle_to_matrix(angles).float(), torch.cumsum(angles[:, 0], 0).float() / 30, fps, CHAIN, name="smooth"
    )


def steady_turn(frames=13, fps=12.0):
    angles = torch.linspace(0, 2, frames)[:, None, None] * torch.tensor([[0.0, 0, 1], [0, 1, 0], [0.6, 0, 0.8]])
    path = torch.linspace(0, 1, frames)[:, None] * torch.tensor([1.0, -2.0, 0.5])
    return Motion(axis_angle_to_matrix(angles), path, fps, CHAIN)


def test_doubling_and_halving_the_rate_changes_nothing():
    motion = smooth_motion()
    back = motion.resampled(60.0).resampled(30.0)
    assert torch.equal(back.rotations, motion.rotations)
    assert torch.equal(back.translation, motion.translation)


@pytest.mark.parametrize("fps", [7.0, 12.5, 30.0, 48.0, 101.0])
def test_resampling_a_steady_turn_is_exact_at_every_time(fps):
    motion = steady_turn()
    resampled = motion.resampled(fps)
    times = torch.arange(len(resampled)) / fps
    axes = torch.tensor([[0.0, 0, 1], [0, 1, 0], [0.6, 0, 0.8]])
    expected = axis_angle_to_matrix(2 * times[:, None, None] / motion.duration * axes)
    torch.testing.assert_close(resampled.rotations, expected, rtol=0, atol=2e-6)
    torch.testing.assert_close(
        resampled.translation, times[:, None] / motion.duration * torch.tensor([1.0, -2.0, 0.5]), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("fps", [24.0, 29.97, 30.0, 60.0, 119.88, 120.0])
def test_resampling_keeps_time(fps):
    motion = smooth_motion(frames=100, fps=120.0)
    resampled = motion.resampled(fps)
    assert torch.equal(resampled.rotations[0], motion.rotations[0])
    assert 0 <= motion.duration - resampled.duration < 1 / fps
    assert resampled.fps == fps


def test_last_frame_is_kept_when_it_falls_on_the_grid():
    motion = smooth_motion(frames=121, fps=120.0)
    assert torch.equal(motion.resampled(30.0).rotations[-1], motion.rotations[-1])


def test_resampling_goes_the_short_way():
    quick = Motion(
        axis_angle_to_matrix(torch.tensor([[[0.0, 0, 3.0]] * 3, [[0.0, 0, -3.0]] * 3])), torch.zeros(2, 3), 30.0, CHAIN
    )
    half = quick.resampled(60.0).rotations[1]
    turned = rotation_angle(quick.rotations[0].mT @ half)
    torch.testing.assert_close(turned, torch.full((3,), np.pi - 3.0), rtol=1e-4, atol=0)


def test_one_frame_resamples_to_one_frame():
    assert len(smooth_motion(frames=1).resampled(120.0)) == 1


def test_clips_join_to_the_whole():
    motion = smooth_motion()
    parts = [motion.clip(0, 10), motion.clip(10, 11), motion.clip(11)]
    assert torch.equal(torch.cat([part.rotations for part in parts]), motion.rotations)
    assert sum(len(part) for part in parts) == len(motion)


@pytest.mark.parametrize(("start", "stop"), [(5, 5), (-1, 3), (0, 99), (7, 2)])
def test_impossible_clips_are_refused(start, stop):
    with pytest.raises(ValueError, match=r"0 <= start < stop <= 41"):
        smooth_motion().clip(start, stop)


@pytest.mark.parametrize("fps", [0.0, -30.0, float("nan"), float("inf")])
def test_impossible_rates_are_refused(fps):
    with pytest.raises(ValueError, match="fps must be a number above 0"):
        smooth_motion().resampled(fps)
    with pytest.raises(ValueError, match="fps must be a number above 0"):
        smooth_motion().at_rate(fps)


def test_file_round_trip(tmp_path):
    motion = smooth_motion()
    motion.save(tmp_path / "m.npz")
    back = Motion.load(tmp_path / "m.npz")
    torch.testing.assert_close(back.rotations, motion.rotations, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.translation, motion.translation)
    torch.testing.assert_close(back.skeleton.rest_joints, motion.skeleton.rest_joints)
    assert back.skeleton.same_tree(motion.skeleton)
    assert (back.fps, back.name) == (motion.fps, motion.name)
    assert (tmp_path / "m.npz").stat().st_size < 4 * (41 * 7 * 3) + 4000


@pytest.mark.parametrize("keep", [0, 1, 40, 500, 1500])
def test_truncated_files_are_named(tmp_path, keep):
    smooth_motion().save(tmp_path / "m.npz")
    whole = (tmp_path / "m.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[:keep])
    with pytest.raises(ValueError, match=r"cut\.npz"):
        Motion.load(tmp_path / "cut.npz")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.npz"):
        Motion.load(tmp_path / "nothing.npz")


def test_foreign_npz_is_named(tmp_path):
    np.savez(tmp_path / "other.npz", poses=np.zeros((3, 66)))
    with pytest.raises(ValueError, match=r"other\.npz is not a motion of this package.*lacks"):
        Motion.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("quaternions", np.zeros((41, 3, 3), np.float32), "quaternions must be"),
        ("quaternions", np.full((41, 3, 4), np.nan, np.float32), "rotations must be finite"),
        ("quaternions", np.ones((41, 2, 4), np.float32), "rotations must be"),
        ("translation", np.zeros((7, 3), np.float32), "translation must be"),
        ("parents", np.array([-1, 0, 5]), "parents must come before"),
        ("fps", np.array("fast"), "could not convert"),
        ("format", np.array("workbench-motion-99"), "this version reads"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path, key, value, message):
    smooth_motion().save(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "bad.npz", **(arrays | {key: value}))
    with pytest.raises(ValueError, match=rf"bad\.npz.*{message}"):
        Motion.load(tmp_path / "bad.npz")


def test_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    smooth_motion().save(tmp_path / "m.npz")
    before = (tmp_path / "m.npz").read_bytes()

    def full_disk(*_args, **_arrays):
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="No space left"):
        smooth_motion(seed=9).save(tmp_path / "m.npz")
    assert (tmp_path / "m.npz").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir() if file.is_file()] == ["m.npz"]


def broken(**changes):
    motion = smooth_motion(frames=5)
    fields = {
        "rotations": motion.rotations.clone(),
        "translation": motion.translation.clone(),
        "fps": 30.0,
        "skeleton": CHAIN,
    }
    return {**fields, **changes}


def test_nan_is_refused_with_its_frame():
    bad = broken()
    bad["rotations"][3, 1, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="rotations must be finite, but frame 3"):
        Motion(**bad)
    bad = broken()
    bad["translation"][2, 1] = float("inf")
    with pytest.raises(ValueError, match="translation must be finite, but frame 2"):
        Motion(**bad)


def test_matrices_that_are_no_rotations_are_refused_with_joint_and_frame():
    bad = broken()
    bad["rotations"][4, 2] *= 1.1
    with pytest.raises(ValueError, match="joint hand in frame 4"):
        Motion(**bad)
    mirrored = broken()
    mirrored["rotations"][0, 1] = -mirrored["rotations"][0, 1]
    with pytest.raises(ValueError, match="joint arm in frame 0"):
        Motion(**mirrored)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"rotations must be \(T, 3, 3, 3\)"):
        Motion(**broken(rotations=torch.eye(3).repeat(5, 2, 1, 1)))
    with pytest.raises(ValueError, match="at least one frame"):
        Motion(**broken(rotations=torch.zeros(0, 3, 3, 3), translation=torch.zeros(0, 3)))


@pytest.mark.parametrize(
    ("names", "parents", "joints", "message"),
    [
        (("a", "b"), (-1,), torch.zeros(2, 3), "needs 2 parents"),
        (("a", "a"), (-1, 0), torch.zeros(2, 3), "unique.*a"),
        (("a", "b"), (-1, -1), torch.zeros(2, 3), "only root"),
        (("a", "b", "c"), (-1, 2, 0), torch.zeros(3, 3), "parents must come before"),
        (("a",), (-1,), torch.full((1, 3), float("nan")), "finite"),
        ((), (), torch.zeros(0, 3), "at least one joint"),
    ],
)
def test_skeletons_that_are_no_trees_are_refused(names, parents, joints, message):
    with pytest.raises(ValueError, match=message):
        Skeleton(names, parents, joints)


def test_unknown_joint_is_named_with_those_there_are():
    with pytest.raises(ValueError, match=r"'foot'.*root, arm, hand"):
        CHAIN.index("foot")


def test_tree_lookups():
    assert CHAIN.children(0) == (1,)
    assert CHAIN.descendants(1) == (1, 2)
    torch.testing.assert_close(CHAIN.offsets.cumsum(0) + CHAIN.rest_joints[0], CHAIN.rest_joints)
