"""Two ways of training on the same seconds: more of them never know less, and both are judged alike."""

from dataclasses import replace

import pytest
import torch

from workbench.learning.fit import FitConfig
from workbench.points import equal_time
from workbench.points.equal_time import judged, trained_for
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.training import PointTrainingConfig, ScanSet

FEW = PointTrainingConfig(
    fit=FitConfig(steps=7, learning_rate=5e-3, warmup=1),
    batch=1,
    queries=200,
    scan_points=300,
    query_size=32,
    precision="float32",
    calibration=1,
)


@pytest.fixture
def scans(body):
    """The naked body, 20 mm fatter."""
    rotations = body.rest_rotations()[None]
    points = body.vertices(rotations, body.mean_shape())[0]
    normals = torch.nn.functional.normalize(points - points.mean(0), dim=1)
    frames = [ScanFrame(points + 0.02 * normals, normals)]
    return [
        ScanSequence.of(frames, outfit="coat", motion="stand", rotations=rotations, betas=body.mean_shape(), fps=30.0)
    ]


def test_longer_training_is_no_worse(scans, body, small_model, monkeypatch):
    monkeypatch.setattr(equal_time, "QUERY_SIZE", 32)
    monkeypatch.setattr(equal_time, "_seconds_a_step", lambda *_: 1.0)
    short, long = (trained_for(seconds, scans, body, small_model.config, FEW) for seconds in (0.1, 40.0))
    assert (short.steps, long.steps) == (1, 40)
    assert long.loss < short.loss
    assert min(short.seconds, long.seconds) > 0


def test_a_model_is_judged_by_every_point_without_being_changed(scans, body, small_model, monkeypatch):
    monkeypatch.setattr(equal_time, "QUERY_SIZE", 32)
    frames = ScanSet.of(body, scans, small_model.config.input_size)
    small_model.eval()
    before = {key: value.clone() for key, value in small_model.state_dict().items()}
    assert judged(small_model, frames, body) == judged(small_model, frames, body)
    assert all(torch.equal(before[key], value) for key, value in small_model.state_dict().items())


def test_a_step_takes_time(scans, body, small_model):
    frames = ScanSet.of(body, scans, small_model.config.input_size)
    assert 0 < equal_time._seconds_a_step(frames, body, small_model.config, replace(FEW, queries=50)) < 10
