"""What a runtime is given by mistake, and what is too much of it: refused in one clear line, or bounded."""

import builtins
import weakref
from dataclasses import replace

import pytest
import torch

from workbench.collisions import tryon as tryon_module
from workbench.collisions.regressor import Regressor
from workbench.collisions.runtime_evaluation import RuntimeEvaluation
from workbench.collisions.runtime_evaluation import rows as runtime_rows
from workbench.collisions.subspace import NetworkConfig, Statistics, Subspace
from workbench.collisions.tryon import POSED_AT_ONCE, TryOn, TryOnConfig, run
from workbench.collisions.tryon_kernels import KernelNetworks
from workbench.collisions.tryon_onnx import OnnxNetworks
from workbench.extras import MissingExtra
from workbench.formats import load_motion, motion_files
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.motion_doubts import mended


@pytest.fixture(scope="module")
def tryon() -> TryOn:
    tryon = TryOn.shipped("tshirt")
    return replace(tryon, networks=KernelNetworks(tryon.regressor, tryon.subspace))


@pytest.fixture(scope="module")
def motion(tryon) -> Motion:
    return load_motion(motion_files(None)[0], tryon.model.body).clip(0, 40)


@pytest.fixture
def without_onnxruntime(monkeypatch):
    real = builtins.__import__

    def absent(name, *rest, **more):
        if name.partition(".")[0] in ("onnx", "onnxruntime"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *rest, **more)

    def absent_module(name):
        return absent(name)

    monkeypatch.setattr("workbench.extras.importlib.import_module", absent_module)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_stream_refuses_frames_that_are_not_finite_and_goes_on_as_if_they_had_not_been(tryon, motion, value):
    clean, hurt = tryon.stream(torch.zeros(10)), tryon.stream(torch.zeros(10))
    frames = list(zip(motion.rotations[:4], motion.translation[:4], strict=True))
    for rotations, translation in frames[:2]:
        for stream in (clean, hurt):
            stream(rotations, translation)
    broken = frames[2][0].clone()
    broken[7, 1, 1] = value
    with pytest.raises(ValueError, match="frame 2 holds NaN or infinity; leave it out"):
        hurt(broken, frames[2][1])
    with pytest.raises(ValueError, match="frame 2 holds NaN or infinity"):
        hurt(frames[2][0], torch.full((3,), value))
    for rotations, translation in frames[2:]:
        assert torch.equal(clean(rotations, translation).garment, hurt(rotations, translation).garment)


def test_a_stream_refuses_another_skeleton(tryon, motion):
    with pytest.raises(ValueError, match="the frame has 24 joints, but the networks 31"):
        tryon.stream(torch.zeros(10))(motion.rotations[0, :24], motion.translation[0])


@pytest.mark.parametrize(
    ("betas", "message"),
    [
        (torch.zeros(16), "a shape has 10 numbers, got 16"),
        (torch.full((10,), torch.nan), "NaN or infinity"),
        (torch.tensor([0.0, -10.0, *8 * [0.0]]), "component 1 is -10 standard deviations"),
    ],
)
def test_a_stream_refuses_shapes_that_no_body_has(tryon, betas, message):
    with pytest.raises(ValueError, match=message):
        tryon.stream(betas)


def test_the_farthest_shape_that_is_allowed_stays_finite(tryon, motion):
    frame = tryon.stream(torch.full((10,), -5.0))(motion.rotations[0], motion.translation[0])
    assert bool(torch.isfinite(frame.garment).all())


def test_a_motion_of_nan_is_refused_before_it_is_dressed(motion):
    rotations = motion.rotations.clone()
    rotations[3] = torch.nan
    with pytest.raises(ValueError, match="rotations must be finite, but frame 3"):
        replace(motion, rotations=rotations)


def test_errors_of_a_capture_are_bridged_when_it_is_asked(motion, tmp_path):
    rotations = motion.rotations[:8].clone()
    lowest = motion.skeleton.index("LowerBack")
    rotations[3:5, lowest] = axis_angle_to_matrix(torch.tensor([2.2, 0.0, 0.0])) @ rotations[3:5, lowest]
    broken = replace(motion, rotations=rotations, translation=motion.translation[:8])
    broken.save(tmp_path / "broken.npz")
    config = TryOnConfig("tshirt", tmp_path / "broken.npz", tmp_path / "out.npz", clear=False)
    torch.testing.assert_close(run(config).motion.rotations, rotations, atol=1e-5, rtol=0)
    found = run(replace(config, mend=True)).motion
    torch.testing.assert_close(found.rotations, mended(broken).rotations, atol=1e-5, rtol=0)
    assert float((found.rotations - motion.rotations[:8]).abs().max()) < 0.2
    assert float((rotations - motion.rotations[:8]).abs().max()) > 1


def test_a_checkpoint_of_another_garment_is_refused(tryon):
    config = NetworkConfig(width=8, depth=1, rank=30)
    other = Subspace("tshirt", Statistics.blank(100, config), config)
    with pytest.raises(ValueError, match=r"garment 'tshirt' has 4630 vertices, but its subspace 100"):
        TryOn.of(other, tryon.regressor)
    with pytest.raises(ValueError, match="subspace is of garment 'tshirt', but the regressor of 'dress'"):
        TryOn.of(tryon.subspace, Regressor("dress", 31, 10, 30.0))
    with pytest.raises(ValueError, match="the body has 31 joints, but the regressor was trained for 24"):
        TryOn.of(tryon.subspace, Regressor("tshirt", 24, 10, 30.0))


def test_the_command_refuses_a_garment_and_a_folder_without_networks(tmp_path):
    motion = motion_files(None)[0]
    with pytest.raises(ValueError, match=r"no subspace .*'cape' ships"):
        run(TryOnConfig("cape", motion, tmp_path / "out.npz"))
    with pytest.raises(FileNotFoundError, match="workbench train subspace"):
        run(TryOnConfig("tshirt", motion, tmp_path / "out.npz", networks=tmp_path))
    assert not (tmp_path / "out.npz").exists()


def test_without_onnxruntime_the_rest_works_and_the_error_says_what_to_install(tryon, motion, without_onnxruntime):
    with pytest.raises(MissingExtra, match=r"needs the package 'onnx.*\.\[runtime\]"):
        OnnxNetworks(tryon.regressor, tryon.subspace)
    assert bool(torch.isfinite(tryon.run(motion.clip(0, 2), torch.zeros(10)).garment).all())
    config = RuntimeEvaluation(("tshirt",), frames=2, reference_frames=1, rounds=1)
    metrics = [row.metric for row in runtime_rows(config)]
    assert not any("onnxruntime" in metric for metric in metrics)
    assert any("one thread, median" in metric for metric in metrics)


def test_a_stream_keeps_nothing_of_the_frames_that_are_gone(tryon, motion):
    stream = tryon.stream(torch.zeros(10))
    gone = []
    for rotations, translation in zip(motion.rotations, motion.translation, strict=True):
        frame = stream(rotations, translation)
        gone += [weakref.ref(tensor) for tensor in (frame.garment, frame.canonical, frame.latent)]
    del frame
    assert not [one for one in gone if one() is not None]


def test_a_long_motion_is_posed_in_pieces(tryon, motion, monkeypatch):
    long = replace(motion, rotations=motion.rotations.repeat(2, 1, 1, 1), translation=motion.translation.repeat(2, 1))
    sizes, real = [], tryon_module.GarmentModel.posed

    def watched(model, X, state):
        sizes.append(len(X))
        return real(model, X, state)

    monkeypatch.setattr(tryon_module.GarmentModel, "posed", watched)
    whole = tryon.run(long, torch.zeros(10))
    assert sum(sizes) == len(whole.garment) == 80
    assert max(sizes) <= POSED_AT_ONCE
