"""Laws of the compact training set."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from workbench.collisions.canonical_set import (
    CanonicalSequence,
    CanonicalSet,
    Projected,
    compact,
    principal_components,
)
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix

JOINTS, SHAPES, VERTICES = 4, 3, 50


def sequence(T: int, seed: int, split: str = "train") -> Projected:
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(6, VERTICES, 3, generator=torch.Generator().manual_seed(99))
    amounts = torch.randn(T, 6, generator=generator) * torch.tensor([0.1, 0.05, 0.02, 0.01, 0.005, 0.002])
    X = 1.0 + torch.einsum("tk,kni->tni", amounts, directions)
    return Projected(
        X,
        CanonicalSequence(
            coefficients=torch.zeros(T, 0),
            rotations=axis_angle_to_matrix(torch.randn(T, JOINTS, 3, generator=generator)),
            translation=torch.randn(T, 3, generator=generator),
            betas=torch.randn(SHAPES, generator=generator),
            valid=torch.rand(T, generator=generator) > 0.2,
            motion_name=f"walk_{seed:02d}",
            split=split,
        ),
    )


def cloth() -> Garment:
    """A strip of VERTICES vertices that does not ship."""
    places = torch.arange(VERTICES)
    vertices = torch.stack([places % 2, places // 2, 0 * places], dim=1).float()
    corner = torch.arange(0, VERTICES - 2, 2)
    faces = torch.cat(
        [torch.stack([corner, corner + 1, corner + 2], 1), torch.stack([corner + 3, corner + 2, corner + 1], 1)]
    )
    return Garment("strip", vertices, 1.1 * vertices, faces)


def small_set(rank: int = 6) -> tuple[CanonicalSet, list[Projected]]:
    made = [sequence(30, 0), sequence(20, 1), sequence(12, 2, "validation")]
    return compact(made, cloth(), 30.0, rank=rank, generator=torch.Generator().manual_seed(0)), made


def test_a_full_basis_gives_every_frame_back():
    data, made = small_set()
    for one, kept in zip(made, data.sequences, strict=True):
        torch.testing.assert_close(data.garments(kept.coefficients), one.canonical, atol=2e-4, rtol=0)


def test_loss_falls_with_the_rank_and_is_what_it_says():
    errors = []
    for rank in (1, 2, 4):
        data, made = small_set(rank)
        gaps = [
            (data.garments(s.coefficients) - one.canonical)[s.valid].square().sum(-1).flatten()
            for one, s in zip(made, data.sequences, strict=True)
        ]
        assert data.error == pytest.approx(float(torch.cat(gaps).mean().sqrt()), rel=1e-3)
        errors.append(data.error)
    assert errors[0] > errors[1] > errors[2]


def test_coefficients_and_garments_are_inverse_on_the_basis():
    data, _ = small_set()
    amounts = torch.randn(5, data.rank) * 0.01
    torch.testing.assert_close(data.coefficients_of(data.garments(amounts)), amounts, atol=1e-5, rtol=1e-3)


def test_round_trip_on_disk(tmp_path):
    data, _ = small_set()
    data.save(tmp_path / "set.npz")
    back = CanonicalSet.load(tmp_path / "set.npz")
    assert (back.garment_name, back.fps, back.error) == (data.garment_name, data.fps, data.error)
    assert back.garment.name == "strip"
    for key, tensor in cloth().tensors().items():  # a garment that does not ship travels with its set
        assert back.garment.tensors()[key].equal(tensor)
    for a, b in zip(data.sequences, back.sequences, strict=True):
        assert (a.motion_name, a.split) == (b.motion_name, b.split)
        torch.testing.assert_close(back.garments(b.coefficients), data.garments(a.coefficients), atol=5e-4, rtol=0)
        torch.testing.assert_close(b.rotations, a.rotations, atol=2e-4, rtol=0)
        torch.testing.assert_close(b.translation, a.translation)
        assert torch.equal(b.valid, a.valid)


def test_kept_leaves_out_rejected_frames_and_other_splits():
    data, made = small_set()
    assert len(data.kept("train")) == sum(int(one.sequence.valid.sum()) for one in made[:2])
    with pytest.raises(ValueError, match="no kept frames for 'validation'"):
        replace(data, sequences=data.of_split("train")).kept("validation")


def test_random_projection_finds_the_principal_directions():
    rows = torch.randn(200, 5, generator=torch.Generator().manual_seed(3)) @ torch.randn(5, 90)
    found = principal_components(rows, 5, torch.Generator().manual_seed(0)) / np.sqrt(30)
    exact = torch.linalg.svd(rows, full_matrices=False).Vh[:5]
    torch.testing.assert_close((found @ exact.T).abs(), torch.eye(5), atol=1e-3, rtol=0)


def test_sequences_of_different_garments_are_refused():
    a, b = sequence(5, 0), sequence(5, 1)
    with pytest.raises(ValueError, match="vertex counts"):
        compact([a, Projected(b.canonical[:, :9], b.sequence)], cloth(), 30.0, rank=2, generator=torch.Generator())


def test_a_truncated_file_is_refused(tmp_path):
    small_set()[0].save(tmp_path / "set.npz")
    whole = (tmp_path / "set.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="not readable as a set of canonical garments"):
        CanonicalSet.load(tmp_path / "cut.npz")
