"""`workbench train fields`: a run ends with four networks, a killed one continues, targets are Eq. 4-6."""

from dataclasses import replace

import pytest
import torch

from workbench.collisions import field_training
from workbench.collisions.body_sdf import ExactSDF, LearnedSDF
from workbench.collisions.diffused_body import LearnedFields, MonteCarloFields
from workbench.collisions.field_training import (
    PoolConfig,
    TrainFieldsConfig,
    make_distance_pool,
    make_pool,
    random_pose_features,
    run,
)
from workbench.learning.fit import FitConfig


def small(out):
    fit = FitConfig(steps=8, warmup=2, checkpoint_every=4)
    return TrainFieldsConfig(
        out=out,
        batch=64,
        pool=PoolConfig(points=400, samples=8),
        weights=fit,
        shape=fit,
        pose=fit,
        sdf=fit,
        sdf_points=400,
    )


def test_a_killed_training_ends_where_the_uninterrupted_one_does(body, tmp_path, monkeypatch):
    whole = run(small(tmp_path / "whole"))

    true_loss, calls = field_training.shape_loss, []

    def dies(*arguments):
        calls.append(1)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return true_loss(*arguments)

    monkeypatch.setattr(field_training, "shape_loss", dies)
    with pytest.raises(KeyboardInterrupt):
        run(small(tmp_path / "killed"))
    assert not (tmp_path / "killed" / "shape.safetensors").exists()
    monkeypatch.setattr(field_training, "shape_loss", true_loss)
    resumed = run(small(tmp_path / "killed"))
    assert resumed.fits["weights"].resumed_at == 8
    assert resumed.fits["shape"].resumed_at == 4
    assert resumed.fits["sdf"].resumed_at == 0
    for name, network in whole.fields.networks().items():
        again = resumed.fields.networks()[name]
        assert all(torch.equal(a, b) for a, b in zip(network.parameters(), again.parameters(), strict=True)), name
    points = torch.rand(5, 3)
    torch.testing.assert_close(
        LearnedFields.load(tmp_path / "killed", body).weights(points), whole.fields.weights(points), atol=2e-3, rtol=0
    )
    torch.testing.assert_close(
        LearnedSDF.load(tmp_path / "killed", body)(points), whole.sdf(points), atol=1e-2, rtol=1e-2
    )


def test_only_the_networks_asked_for_are_trained_and_written(tmp_path):
    trained = run(replace(small(tmp_path), networks=("sdf",)))
    assert list(trained.fits) == ["sdf"]
    assert [file.name for file in tmp_path.glob("*.safetensors")] == ["sdf.safetensors"]


def test_a_run_begins_where_its_start_ended(body, tmp_path):
    first = run(replace(small(tmp_path / "first"), networks=("shape", "sdf")))
    still = FitConfig(steps=1, learning_rate=0.0, last_rate=0.0)
    again = run(
        replace(
            small(tmp_path / "again"),
            networks=("shape", "sdf"),
            start=tmp_path / "first",
            shape=still,
            sdf=still,
        )
    )
    points = torch.rand(5, 3)
    torch.testing.assert_close(again.sdf(points), first.sdf(points), atol=1e-2, rtol=1e-2)
    assert (LearnedSDF(body)(points) - first.sdf(points)).abs().max() > 0.02
    for one, two in zip(first.fields.shape_net.parameters(), again.fields.shape_net.parameters(), strict=True):
        torch.testing.assert_close(two, one, atol=1e-3, rtol=1e-3)
    with pytest.raises(ValueError, match="there is no trained network .*pose"):
        run(replace(small(tmp_path / "none"), networks=("pose",), start=tmp_path / "first"))


def test_the_pool_holds_the_definition(body):
    pool = make_pool(body, PoolConfig(points=200, samples=32), seed=0)
    truth = MonteCarloFields(body, samples=32, seed=0).expectation(pool.points)
    assert len(pool.points) == 200
    assert (pool.rows.float() - truth).abs().max() < 3e-4
    near = ExactSDF(body)(pool.points).abs() < 0.06
    assert 0.6 < near.float().mean() < 0.85


def test_distances_are_exact(body):
    pool = make_distance_pool(body, 300, seed=0)
    torch.testing.assert_close(pool.distances, ExactSDF(body)(pool.points))


def test_poses_repeat_and_differ(body):
    one, same = random_pose_features(body, 5, seed=1), random_pose_features(body, 5, seed=1)
    assert torch.equal(one, same)
    assert (one[0] - one[1]).norm() > 0.1
    assert one.shape[1] == len(body.pose_map)


def test_the_paper_size_is_longer():
    ours, paper = TrainFieldsConfig(), TrainFieldsConfig.paper_size()
    assert paper.weights.steps == 10 * ours.weights.steps
    assert replace(paper.weights, steps=ours.weights.steps) == ours.weights
