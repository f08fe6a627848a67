"""Laws of workbench.collisions.sequences: storage loses less than it says, splits share no motion."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.collisions.sequences import (
    STORAGE_STEP,
    SimulatedSequence,
    predict,
    restore,
    shipped_sequence,
    shipped_sequences,
    spanning_tree,
    split_by_motion,
    unzigzag,
    zigzag,
)
from workbench.geometry.rotations import axis_angle_to_matrix


def sequence(seed=0, frames=7, motion="walk_00", far=0.0, parts=1):
    generator = torch.Generator().manual_seed(seed)
    mesh = trimesh.creation.icosphere(2, 0.4)
    faces = torch.tensor(mesh.faces, dtype=torch.int64)
    vertices = torch.tensor(mesh.vertices, dtype=torch.float32)
    faces = torch.cat([faces + k * len(vertices) for k in range(parts)])
    vertices = torch.cat([vertices + k for k in range(parts)])
    translation = torch.randn(frames, 3, generator=generator).cumsum(0) * 0.1 + far
    wobble = torch.randn(frames, len(vertices), 3, generator=generator) * 0.003
    return SimulatedSequence(
        garment=vertices + translation[:, None] + wobble,
        rotations=axis_angle_to_matrix(torch.randn(frames, 4, 3, generator=generator)),
        translation=translation,
        betas=torch.randn(10, generator=generator),
        faces=faces,
        valid=torch.rand(frames, generator=generator) > 0.3,
        fps=30.0,
        garment_name="ball",
        motion_name=motion,
        made_by='{"seed": 0}',
    )


@pytest.mark.parametrize("far", [0.0, 20.0])
def test_round_trip_within_the_stated_error(tmp_path, far):
    before = sequence(far=far)
    before.save(tmp_path / "s.npz")
    after = SimulatedSequence.load(tmp_path / "s.npz")
    rounding = 2e-6 * max(1.0, far / 10)  # float32 at that distance
    assert (after.garment - before.garment).abs().max() <= STORAGE_STEP / 2 + rounding
    assert STORAGE_STEP / 2 <= 0.02e-3
    assert torch.allclose(after.rotations, before.rotations, atol=2e-6)
    for name in ("translation", "betas", "faces", "valid"):
        assert torch.equal(getattr(after, name), getattr(before, name))
    assert (after.fps, after.garment_name, after.motion_name, after.made_by) == (30.0, "ball", "walk_00", '{"seed": 0}')


def test_storing_again_changes_nothing(tmp_path):
    sequence().save(tmp_path / "a.npz")
    once = SimulatedSequence.load(tmp_path / "a.npz")
    once.save(tmp_path / "b.npz")
    twice = SimulatedSequence.load(tmp_path / "b.npz")
    assert (twice.garment - once.garment).abs().max() < 1e-6


def test_smooth_movement_is_stored_small(tmp_path):
    still = sequence(frames=60)
    smooth = dataclasses.replace(still, garment=still.garment[:1] - still.translation[0] + still.translation[:, None])
    smooth.save(tmp_path / "s.npz")
    assert (tmp_path / "s.npz").stat().st_size < 0.2 * smooth.garment.numel() * 4


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_prediction_and_zigzag_are_undone_exactly(seed):
    rng = np.random.default_rng(seed)
    ticks = rng.integers(-(2**24), 2**24, (5, 84, 3)).astype(np.int32)
    mesh = trimesh.creation.icosphere(1)
    faces = np.concatenate([mesh.faces, mesh.faces + 42]).astype(np.int64)  # two parts
    tree = spanning_tree(faces, 84)
    assert sorted(np.concatenate(tree.levels)) == list(range(84))
    assert (tree.parent < 0).sum() == 2
    assert np.array_equal(restore(predict(ticks, tree), tree), ticks)
    assert np.array_equal(unzigzag(zigzag(ticks)), ticks)


def test_frames_must_agree():
    whole = sequence()
    with pytest.raises(ValueError, match="valid has 3 frames, but the garment has 7"):
        dataclasses.replace(whole, valid=whole.valid[:3])


def test_a_clip_is_part_of_the_whole():
    whole = sequence()
    part = whole.clip(2, 5)
    assert len(part) == 3
    assert torch.equal(part.garment, whole.garment[2:5])
    assert torch.equal(part.valid, whole.valid[2:5])


def test_a_diverged_simulation_is_not_stored(tmp_path):
    bad = sequence()
    bad.garment[3, 2] = float("nan")
    with pytest.raises(ValueError, match="diverged simulation cannot be stored"):
        bad.save(tmp_path / "s.npz")
    assert list(tmp_path.iterdir()) == []


def test_foreign_and_truncated_files_get_one_line(tmp_path):
    np.savez(tmp_path / "foreign.npz", poses=np.zeros(3))
    with pytest.raises(ValueError, match="is not a simulated sequence: it lacks"):
        SimulatedSequence.load(tmp_path / "foreign.npz")
    sequence().save(tmp_path / "s.npz")
    content = (tmp_path / "s.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="not readable as a simulated sequence"):
        SimulatedSequence.load(tmp_path / "half.npz")
    with pytest.raises(FileNotFoundError, match="expected a simulated sequence"):
        SimulatedSequence.load(tmp_path / "none.npz")


def test_no_motion_is_on_two_sides_of_a_split():
    many = [sequence(seed, motion=f"walk_{seed % 10:02d}", frames=2) for seed in range(30)]
    split = split_by_motion(many, np.random.default_rng(1))
    sides = [{s.motion_name for s in side} for side in (split.train, split.validation, split.test)]
    assert [len(side) for side in sides] == [7, 1, 2]
    assert not (sides[0] & sides[1] or sides[0] & sides[2] or sides[1] & sides[2])
    assert len(split.train) + len(split.validation) + len(split.test) == 30
    again = split_by_motion(many, np.random.default_rng(1))
    assert [s.motion_name for s in again.test] == [s.motion_name for s in split.test]


def test_a_split_that_leaves_nothing_to_train_on_is_refused():
    with pytest.raises(ValueError, match="lower the shares or simulate more motions"):
        split_by_motion([sequence()], np.random.default_rng(0), test_share=1.0)


def test_what_ships_is_clean_and_small(body):
    everything = shipped_sequences()
    assert everything
    for s in everything:
        assert s.valid.float().mean() > 0.8
        assert s.rotations.shape[1:] == (len(body.skeleton), 3, 3)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="no sequence 'robe' ships; there are: .*tshirt_demo"):
        shipped_sequence("robe")
