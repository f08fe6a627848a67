"""The optimisation loop: it minimises, resumes to the same result, and refuses checkpoints that are not its own."""

import math

import pytest
import torch

from workbench.learning.fit import FitConfig, fit, learning_rate_at
from workbench.learning.mlp import MLP

CONFIG = FitConfig(steps=60, learning_rate=1e-2, warmup=5, checkpoint_every=20)


class Killed(Exception):
    pass


def train(checkpoint=None, *, config=CONFIG, stop_at=None):
    """A small regression whose batches come from the generator."""
    network = MLP(1, 1, width=16, depth=2, generator=torch.Generator().manual_seed(0))

    def loss_of(step, generator):
        if step == stop_at:
            raise Killed
        x = torch.rand(64, 1, generator=generator)
        return (network(x) - torch.sin(6 * x)).square().mean()

    result = fit(
        list(network.parameters()),
        loss_of,
        config,
        generator=torch.Generator().manual_seed(1),
        checkpoint=checkpoint,
    )
    return network, result


def test_it_minimises():
    _, short = train(config=FitConfig(steps=20, learning_rate=1e-2, warmup=5))
    _, long = train(config=FitConfig(steps=200, learning_rate=1e-2, warmup=5))
    assert long.loss < 0.6 * short.loss


def test_a_killed_run_ends_where_the_uninterrupted_one_does(tmp_path):
    whole, _ = train()
    with pytest.raises(Killed):
        train(tmp_path / "fit.safetensors", stop_at=47)
    resumed, result = train(tmp_path / "fit.safetensors")
    assert result.resumed_at == 40
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_finished_run_does_nothing_more(tmp_path):
    done, _ = train(tmp_path / "fit.safetensors")
    again, result = train(tmp_path / "fit.safetensors", stop_at=0)
    assert result.resumed_at == 60
    assert all(torch.equal(a, b) for a, b in zip(done.parameters(), again.parameters(), strict=True))


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    train(tmp_path / "fit.safetensors")
    with pytest.raises(ValueError, match="belongs to another run"):
        train(tmp_path / "fit.safetensors", config=FitConfig(steps=61, checkpoint_every=20))
    other = [torch.zeros(3, requires_grad=True)]
    with pytest.raises(ValueError, match=r"holds parameters of shapes"):
        fit(
            other,
            lambda *_: other[0].sum(),
            CONFIG,
            generator=torch.Generator(),
            checkpoint=tmp_path / "fit.safetensors",
        )


def test_a_truncated_checkpoint_is_named(tmp_path):
    path = tmp_path / "fit.safetensors"
    train(path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=r"fit.safetensors is unreadable .*delete it to start anew"):
        train(path)


def test_a_loss_that_is_not_finite_ends_the_run():
    parameter = torch.zeros(1, requires_grad=True)
    with pytest.raises(FloatingPointError, match="the loss is nan at step 0"):
        fit([parameter], lambda *_: (parameter * math.nan).sum(), CONFIG, generator=torch.Generator())


def test_the_rate_rises_then_falls_to_its_end():
    rates = [learning_rate_at(step, CONFIG) for step in range(CONFIG.steps)]
    assert rates.index(max(rates)) in (CONFIG.warmup - 1, CONFIG.warmup)
    assert rates[-1] == pytest.approx(CONFIG.last_rate)
    assert all(a >= b for a, b in zip(rates[CONFIG.warmup :], rates[CONFIG.warmup + 1 :], strict=False))


def test_each_step_is_watched():
    seen = []
    parameter = torch.ones(1, requires_grad=True)
    config = FitConfig(steps=5)
    fit(
        [parameter],
        lambda *_: parameter.square().sum(),
        config,
        generator=torch.Generator(),
        watch=lambda step, loss: seen.append((step, loss)),
    )
    assert [step for step, _ in seen] == [0, 1, 2, 3, 4]
    assert seen[-1][1] < seen[0][1]
