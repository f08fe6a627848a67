"""Laws of regressor (Eq. 1, 18), runtime and its ONNX form, with networks that are small or untrained."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from workbench.collisions.posed_corrective import PosedCorrective
from workbench.collisions.regressor import (
    Regressor,
    RegressorTraining,
    TrainRegressorConfig,
    acceleration_loss,
    position_loss,
    run,
    velocity_loss,
)
from workbench.collisions.subspace import Decoder, NetworkConfig, Statistics, Subspace
from workbench.collisions.tryon import TryOn, checked_shape, shape_from_words
from workbench.collisions.tryon_onnx import OnnxNetworks, write_onnx
from workbench.formats.mesh_sequence import read_dressed_sequence
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning.fit import FitConfig
from workbench.motion import Motion

NETWORK = NetworkConfig(width=32, depth=2, rank=30)


@pytest.fixture(scope="module")
def tryon(small_set, body) -> TryOn:
    subspace = Subspace("tshirt", Statistics.of(small_set, NETWORK), NETWORK).eval()
    regressor = Regressor("tshirt", len(body.parents), body.shape_count, 30.0, torch.Generator().manual_seed(1)).eval()
    regressor.standardise(small_set.of_split("train"))
    return TryOn.of(subspace, regressor)


@pytest.fixture(scope="module")
def motion(small_set, body) -> Motion:
    s = small_set.sequences[2]
    return Motion(s.rotations, s.translation, 30.0, body.skeleton, "walk_3")


def test_losses_vanish_at_the_truth_and_skip_rejected_frames():
    wanted = torch.randn(2, 9, 25)
    kept = torch.ones(2, 9, dtype=torch.bool)
    kept[0, 4] = False
    found = wanted.clone()
    found[0, 4] += 100
    for loss in (position_loss, velocity_loss, acceleration_loss):
        assert float(loss(found, wanted, kept)) == 0
        assert float(loss(found + torch.randn_like(found), wanted, kept)) > 0


def test_velocity_is_blind_to_an_offset_and_acceleration_to_a_drift():
    wanted, kept = torch.zeros(1, 9, 25), torch.ones(1, 9, dtype=torch.bool)
    drift = torch.arange(9.0)[None, :, None].expand(1, 9, 25)
    assert float(velocity_loss(wanted + 5, wanted, kept)) == 0
    assert float(velocity_loss(wanted + drift, wanted, kept)) > 0
    assert float(acceleration_loss(wanted + drift, wanted, kept)) < 1e-5


def test_streaming_gives_what_the_whole_motion_gives(tryon, motion):
    betas = torch.linspace(-1, 1, 10)
    whole = tryon.run(motion, betas)
    stream = tryon.stream(betas)
    frames = [stream(r, h) for r, h in zip(motion.rotations, motion.translation, strict=True)]
    torch.testing.assert_close(torch.stack([f.latent for f in frames]), whole.latent, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(torch.stack([f.garment for f in frames]), whole.garment, atol=2e-4, rtol=1e-3)


def test_onnx_gives_what_torch_gives(tryon, motion):
    fast = replace(tryon, networks=OnnxNetworks(tryon.regressor, tryon.subspace))
    a, b = tryon.stream(torch.zeros(10)), fast.stream(torch.zeros(10))
    for r, h in zip(motion.rotations, motion.translation, strict=True):
        one, two = a(r, h), b(r, h)
        torch.testing.assert_close(two.garment, one.garment, atol=1e-4, rtol=1e-4)


def test_onnx_files_are_written_and_run(tryon, tmp_path):
    corrective = TryOn.shipped("tshirt").corrective
    assert isinstance(corrective, PosedCorrective)
    written = write_onnx(tmp_path, tryon.regressor, tryon.subspace, corrective)
    kinds = ["regressor", "decoder", "corrective"]
    assert [path.name for path in written] == [f"tshirt-{kind}.onnx" for kind in kinds]
    assert write_onnx(tmp_path, tryon.regressor, tryon.subspace) == written[:2]
    session = onnxruntime.InferenceSession(str(written[1]))
    (X,) = session.run(None, {"latent": np.zeros((1, 25), np.float32)})
    with torch.no_grad():
        wanted = tryon.subspace.decode(torch.zeros(25))
    np.testing.assert_allclose(np.asarray(X).reshape(-1, 3), wanted.numpy(), atol=1e-5)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_shortest_motions_work(tryon, motion, frames):
    assert tryon.run(motion.clip(0, frames), torch.zeros(10)).garment.shape[0] == frames


def test_a_fast_frame_rate_is_resampled(tryon, motion):
    slow = tryon.run(motion, torch.zeros(10))
    fast = tryon.run(motion.resampled(240.0), torch.zeros(10))
    assert len(fast.latent) == len(slow.latent)
    assert float((fast.garment - slow.garment).norm(dim=-1).mean()) < 2e-3


def test_a_pose_far_outside_of_the_training_stays_finite(tryon, motion):
    tumbling = axis_angle_to_matrix(3 * torch.randn(24, 31, 3))
    wild = replace(motion, rotations=tumbling, translation=motion.translation * 99)
    assert bool(torch.isfinite(tryon.run(wild, torch.zeros(10)).garment).all())


def test_bad_shapes_are_refused(tryon, motion, body):
    with pytest.raises(ValueError, match="a shape has 10 numbers, got 3"):
        tryon.run(motion, torch.zeros(3))
    with pytest.raises(ValueError, match="NaN or infinity"):
        checked_shape(torch.full((10,), torch.nan), body)
    with pytest.raises(ValueError, match="10 standard deviations from the mean"):
        checked_shape(torch.tensor([10.0] + 9 * [0.0]), body)
    with pytest.raises(ValueError, match="numbers with commas"):
        shape_from_words("1;2", body)
    with pytest.raises(ValueError, match="11 betas given"):
        shape_from_words("0,0,0,0,0,0,0,0,0,0,0", body)
    assert shape_from_words("1,-0.5", body).tolist() == [1.0, -0.5, *8 * [0.0]]


def test_networks_of_different_garments_are_refused(tryon):
    other = Regressor("dress", 31, 10, 30.0)
    with pytest.raises(ValueError, match="trained together"):
        TryOn.of(tryon.subspace, other)


def test_the_result_is_a_dressed_sequence(tryon, motion, tmp_path):
    result = tryon.run(motion, torch.zeros(10))
    result.save(tmp_path / "dressed.npz")
    back = read_dressed_sequence(tmp_path / "dressed.npz")
    np.testing.assert_array_equal(back.garment.vertices, result.garment.numpy())
    np.testing.assert_array_equal(back.body.faces, result.body_faces.numpy())
    with np.load(tmp_path / "dressed.npz") as file:
        assert file["latent"].shape == (24, 25)
        assert file["canonical"].shape == result.garment.shape


@pytest.fixture(scope="module")
def trained(small_set, tmp_path_factory) -> TrainRegressorConfig:
    folder: Path = tmp_path_factory.mktemp("networks")
    small_set.save(folder / "set.npz")
    Subspace("tshirt", Statistics.of(small_set, NETWORK), NETWORK).save(folder / "tshirt-subspace.safetensors")
    few = FitConfig(steps=4, warmup=1, checkpoint_every=2)
    return TrainRegressorConfig(
        data=folder / "set.npz",
        out=folder,
        window=10,
        batch=3,
        describe=few,
        fit=few,
        watch_every=2,
    )


def test_training_writes_a_regressor_that_loads_and_continues(trained):
    first = run(trained)
    again = run(trained)  # everything is there: the same result, nothing trained anew
    back = Regressor.load(trained.out / "tshirt-regressor.safetensors")
    for name, tensor in first.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(back.state_dict()[name], tensor, atol=2e-2, rtol=2e-3)
    assert [entry["step"] for entry in back.story["curves"]] == [2, 4]


def test_undisturbed_is_what_will_be_said(tryon, motion):
    given = (motion.rotations[None], motion.translation[None], torch.ones(1, 10))
    without = tryon.regressor.disturbed(*given, 0.0, 0.0, torch.Generator())
    torch.testing.assert_close(without, tryon.regressor(*given))


def test_disturbance_comes_from_the_generator_alone(tryon, motion):
    """A run that was ended goes on with the same chance, and takes none from others."""
    given, regressor = (motion.rotations[None], motion.translation[None], torch.ones(1, 10)), tryon.regressor
    others = torch.get_rng_state()
    regressor.train()
    once, again, other = (
        regressor.disturbed(*given, 0.2, 0.3, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6)
    )
    regressor.eval()
    assert torch.equal(once, again)
    assert not torch.equal(once, other)
    assert torch.equal(torch.get_rng_state(), others)


def test_latents_count_by_how_far_they_move_the_garment(trained):
    training = RegressorTraining.of(trained)
    assert float(training.counts.mean()) == pytest.approx(1)
    louder = replace(training)
    decoder = louder.subspace.decoder
    assert isinstance(decoder, Decoder)
    decoder.basis[3] *= 5
    assert float(louder.counts[3] / louder.counts[4]) > 3 * float(training.counts[3] / training.counts[4])


def test_a_damaged_regressor_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="workbench train regressor"):
        Regressor.load(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match="is damaged"):
        Regressor.load(tmp_path / "bad.safetensors")
