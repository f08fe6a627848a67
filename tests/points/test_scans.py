"""Scan sequences: storage within 0.02 mm, thinning, damage."""

import numpy as np
import pytest
import torch

from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.points.scans import ScanFrame, ScanSequence, load_scans, outfits_of


@pytest.fixture
def sequence(rng):
    normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(4, 50, 3))).float(), dim=-1)
    points = torch.from_numpy(rng.uniform(-1.1, 1.1, size=(4, 50, 3))).float()
    return ScanSequence.of(
        [ScanFrame(p, n) for p, n in zip(points, normals, strict=True)],
        outfit="dress",
        motion="walk",
        rotations=axis_angle_to_matrix(torch.from_numpy(rng.normal(size=(4, 5, 3))).float()),
        betas=torch.arange(3.0),
        fps=30.0,
    ), (points, normals)


def test_frames_return_within_the_storage_step(tmp_path, sequence):
    packed, (points, normals) = sequence
    packed.save(tmp_path / "s.npz")
    read = ScanSequence.load(tmp_path / "s.npz")
    assert (read.outfit, read.motion, read.fps, len(read)) == ("dress", "walk", 30.0, 4)
    for t in range(4):
        frame = read.frame(t)
        assert (frame.points - points[t]).abs().max() < 2e-5
        assert torch.rad2deg((frame.normals * normals[t]).sum(-1).clamp(-1, 1).arccos()).max() < 0.5
        torch.testing.assert_close(frame.normals.norm(dim=-1), torch.ones(50))
    torch.testing.assert_close(read.rotations, packed.rotations, atol=1e-5, rtol=0)
    torch.testing.assert_close(read.betas, packed.betas)


def test_thinning_keeps_every_other_frame(sequence):
    packed, _ = sequence
    half = packed.every(2)
    assert len(half) == 2
    assert half.fps == 15.0
    torch.testing.assert_close(half.frame(1).points, packed.frame(2).points)
    with pytest.raises(ValueError, match="stride is 0"):
        packed.every(0)


def test_folders(tmp_path, sequence):
    with pytest.raises(ValueError, match="no scan sequences"):
        load_scans(tmp_path)
    sequence[0].save(tmp_path / "a.npz")
    sequence[0].save(tmp_path / "b.npz")
    assert outfits_of(load_scans(tmp_path)) == ("dress",)


def test_foreign_files_are_refused(tmp_path, sequence):
    np.savez(tmp_path / "x.npz", points=np.zeros(3))
    with pytest.raises(ValueError, match="is not a scan sequence: it lacks"):
        ScanSequence.load(tmp_path / "x.npz")
    sequence[0].save(tmp_path / "s.npz")
    np.savez(tmp_path / "y.npz", **{**np.load(tmp_path / "s.npz"), "format": np.array("scan-sequence-9")})
    with pytest.raises(ValueError, match="format 'scan-sequence-9'; expected 'scan-sequence-1'"):
        ScanSequence.load(tmp_path / "y.npz")


def test_a_part_of_a_sequence_is_that_part(sequence):
    packed, _ = sequence
    part = packed.first(3).thinned(20)
    assert len(part) == 3 and len(part.rotations) == 3
    for t in range(3):
        torch.testing.assert_close(part.frame(t).points, packed.frame(t).points[:20])
        torch.testing.assert_close(part.frame(t).normals, packed.frame(t).normals[:20])
    assert len(packed.first(9)) == 4
    with pytest.raises(ValueError, match="0 frames are asked for; expected 1 or more"):
        packed.first(0)
    with pytest.raises(ValueError, match="51 points are asked for of scans of 50; expected 1 to 50"):
        packed.thinned(51)
