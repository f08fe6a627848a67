"""The one optimisation loop: parameters, a loss a step -> trained parameters, a checkpoint that resumes.

A run that is killed continues from its checkpoint with the same parameters, Adam moments, step and generator state, so
it ends where the uninterrupted run ends (bit by bit on one thread).  It computes where the parameters are; a checkpoint
continues on any device.  Under torchrun all processes take each step together (`parallel`).
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from workbench.learning.parallel import Processes, processes
from workbench.store import atomic_write


@dataclass(frozen=True)
class FitConfig:
    """Adam with a cosine from `learning_rate` to `last_rate`.

    Defaults are ours (the paper names no optimiser; facts.md 1: nearest documented values Adam 1e-3 to 5e-4, clip 5).
    """

    steps: int = 5000
    learning_rate: float = 1e-3
    last_rate: float = 1e-5  # reached at the last step, along a cosine
    warmup: int = 100  # steps of linear rise to learning_rate
    clip_norm: float = 5.0
    checkpoint_every: int = 250  # steps


@dataclass(frozen=True)
class FitResult:
    """What a run reports: the step it stood at when it began (0 unless resumed), steps done in all, mean loss of the
    last tenth of the steps it ran itself."""

    resumed_at: int
    steps: int
    loss: float


def learning_rate_at(step: int, config: FitConfig) -> float:
    """Linear warm-up, then half a cosine from learning_rate to last_rate."""
    if step < config.warmup:
        return config.learning_rate * (step + 1) / config.warmup
    progress = (step - config.warmup) / max(1, config.steps - 1 - config.warmup)
    fall = 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))
    return config.last_rate + (config.learning_rate - config.last_rate) * fall


def fit(
    parameters: Sequence[Tensor],
    loss_of: Callable[[int, torch.Generator], Tensor],
    config: FitConfig,
    *,
    generator: torch.Generator,
    checkpoint: Path | None = None,
    label: str = "fit",
    watch: Callable[[int, float], None] | None = None,
) -> FitResult:
    """Minimise `loss_of(step, generator)` over `parameters`, in place.

    All chance of a step must come from `generator`, a CPU one, or a resumed run differs.  `checkpoint` (safetensors) is
    written every `checkpoint_every` steps and at the end, whole or not at all; if it exists, the run continues from it.
    `watch(step, loss)` is called after each step (logging).  Raises ValueError for a checkpoint of other parameters or
    another config, FloatingPointError when the loss is not finite.

    Under torchrun the loss is the mean over the processes, each with chance of its own; only the first one writes the
    checkpoint, shows progress and is watched.
    """
    parameters, team = list(parameters), processes()
    team.own_chance(generator)
    optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)
    start = 0
    if checkpoint is not None and checkpoint.exists():
        start = _restore(checkpoint, parameters, optimizer, generator, config, team)
    team.share(parameters)
    losses: list[float] = []
    progress: dict[str, Any] = {"desc": label, "mininterval": 5.0, "disable": not team.first}
    with tqdm(range(start, config.steps), initial=start, total=config.steps, **progress) as bar:
        for step in bar:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate_at(step, config)
            optimizer.zero_grad(set_to_none=True)
            loss = loss_of(step, generator)
            loss.backward()
            value = team.average(parameters, loss)
            if not math.isfinite(value):
                raise FloatingPointError(f"{label}: the loss is {value} at step {step}; lower the learning rate")
            torch.nn.utils.clip_grad_norm_(parameters, config.clip_norm)
            optimizer.step()
            losses.append(value)
            bar.set_postfix(loss=f"{value:.3g}", refresh=False)
            if watch is not None and team.first:
                watch(step, value)
            done = step + 1
            if checkpoint is not None and (done % config.checkpoint_every == 0 or done == config.steps):
                _save(checkpoint, parameters, optimizer, team, team.chances(generator), config, done)
    team.wait()
    tail = losses[-max(1, config.steps // 10) :]
    return FitResult(resumed_at=start, steps=config.steps, loss=sum(tail) / len(tail) if tail else math.nan)


def _save(
    path: Path,
    parameters: Sequence[Tensor],
    optimizer: torch.optim.Adam,
    team: Processes,
    chances: Sequence[Tensor],
    config: FitConfig,
    step: int,
) -> None:
    if not team.first:
        return
    tensors = {_chance(rank): state for rank, state in enumerate(chances)}
    for index, parameter in enumerate(parameters):
        state = optimizer.state[parameter]
        tensors[f"parameter.{index}"] = parameter.detach().cpu().contiguous()
        tensors[f"mean.{index}"] = state["exp_avg"].cpu().contiguous()
        tensors[f"square.{index}"] = state["exp_avg_sq"].cpu().contiguous()
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"step": str(step), "config": json.dumps(asdict(config), sort_keys=True)}
    with atomic_write(path) as part:
        save_file(tensors, part, metadata=metadata)


def _restore(
    path: Path,
    parameters: Sequence[Tensor],
    optimizer: torch.optim.Adam,
    generator: torch.Generator,
    config: FitConfig,
    team: Processes,
) -> int:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  not a dict
    except (SafetensorError, OSError) as error:
        raise ValueError(f"checkpoint {path} is unreadable ({error}); delete it to start anew") from error
    expected = json.dumps(asdict(config), sort_keys=True)
    if metadata.get("config") != expected:
        raise ValueError(
            f"checkpoint {path} belongs to another run: its config is {metadata.get('config')}, this one's {expected}; "
            "delete it or choose another path"
        )
    saved_by = sum(name.startswith(_chance(0)) for name in tensors)
    if saved_by != team.count:
        raise ValueError(
            f"checkpoint {path} is of a run on {saved_by} processes, this one has {team.count}; start as many again "
            f"(torchrun --nproc-per-node {saved_by}), delete it or choose another path"
        )
    shapes = [tuple(p.shape) for p in parameters]
    saved = [tuple(tensors[f"parameter.{i}"].shape) for i in range(len(tensors)) if f"parameter.{i}" in tensors]
    if saved != shapes:
        raise ValueError(f"checkpoint {path} holds parameters of shapes {saved}, expected {shapes}")
    step = int(metadata["step"])
    for index, parameter in enumerate(parameters):
        parameter.data.copy_(tensors[f"parameter.{index}"])
        optimizer.state[parameter] = {
            "step": torch.tensor(float(step)),
            "exp_avg": tensors[f"mean.{index}"].to(parameter.device),
            "exp_avg_sq": tensors[f"square.{index}"].to(parameter.device),
        }
    generator.set_state(tensors[_chance(team.rank)])
    return step


def _chance(rank: int) -> str:
    return f"generator.{rank}" if rank else "generator"
