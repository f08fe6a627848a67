"""Two processes under torchrun: they agree, they average, they resume, and they are not mistaken for one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from workbench.learning.fit import FitConfig, fit
from workbench.learning.parallel import Processes, processes

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="torchrun's store needs libuv there")

# argv: checkpoint, step to stop at (-1: never), where to write the parameters, whether batches are drawn by chance
SCRIPT = """
import atexit
import sys
from pathlib import Path

import torch
from torch import distributed

# runs last; a word and its line end in one piece, or unbuffered processes write "leftleft"
atexit.register(lambda: print("together\\n" if distributed.is_initialized() else "left\\n", end=""))

from workbench.learning.fit import FitConfig, fit
from workbench.learning.parallel import processes

checkpoint, stop_at, out, by_chance = Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]), sys.argv[4] == "chance"
team = processes()
x = torch.nn.Parameter(torch.full((3,), float(team.rank)))
targets = torch.tensor([[1.0, 2.0, 3.0], [5.0, -2.0, 1.0]])


def loss_of(step, generator):
    if step == stop_at:
        sys.exit(3)
    aim = torch.randn(3, generator=generator) if by_chance else targets[team.rank]
    return (x - aim).square().sum()


seen = []
config = FitConfig(steps=12, learning_rate=0.1, warmup=1, clip_norm=1e9, checkpoint_every=4)
fit([x], loss_of, config, generator=torch.Generator().manual_seed(1), checkpoint=checkpoint,
    watch=lambda step, loss: seen.append(loss))
torch.save({"x": x.data, "seen": seen}, out / f"{team.rank}.pt")
"""
CONFIG = FitConfig(steps=12, learning_rate=0.1, warmup=1, clip_norm=1e9, checkpoint_every=4)


def torchrun(folder: Path, *command: str, count: int = 2) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    return subprocess.run(
        [*launcher, *command], cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )


def both(folder: Path, checkpoint: str, *, stop_at: int = -1, chance: bool = True) -> list[dict]:
    script = folder / "script.py"
    script.write_text(SCRIPT)
    done = torchrun(folder, str(script), checkpoint, str(stop_at), str(folder), "chance" if chance else "fixed")
    assert (done.returncode == 0) == (stop_at < 0), done.stderr[-2000:]
    assert done.stdout.split() == ["left", "left"]  # else gloo's threads may abort Python while it ends
    return [] if stop_at >= 0 else [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in (0, 1)]


def test_without_torchrun_there_is_one_process_that_leads():
    alone = processes()
    assert alone == Processes(0, 1)
    assert alone.first
    x = torch.nn.Parameter(torch.tensor([2.0]))
    loss = x.square().sum()
    loss.backward()
    assert alone.average([x], loss) == 4
    assert float(x.grad[0]) == 4  # pyright: ignore[reportOptionalSubscript]


def test_two_processes_end_alike_where_one_ends_that_minimises_their_mean(tmp_path):
    first, second = both(tmp_path, "c.safetensors", chance=False)
    assert torch.equal(first["x"], second["x"])
    assert len(first["seen"]) == 12
    assert second["seen"] == []  # the first one alone is watched
    x = torch.nn.Parameter(torch.zeros(3))
    targets = torch.tensor([[1.0, 2.0, 3.0], [5.0, -2.0, 1.0]])
    fit([x], lambda *_: (x - targets).square().sum(1).mean(), CONFIG, generator=torch.Generator())
    torch.testing.assert_close(first["x"], x.data)


def test_a_killed_pair_ends_where_the_uninterrupted_one_does_and_other_counts_are_refused(tmp_path):
    (whole, _) = both(tmp_path, "whole.safetensors")
    both(tmp_path, "killed.safetensors", stop_at=6)
    states = load_file(tmp_path / "killed.safetensors")
    assert not torch.equal(states["generator"], states["generator.1"])  # each draws its own batches
    (resumed, _) = both(tmp_path, "killed.safetensors")
    assert torch.equal(whole["x"], resumed["x"])
    x = torch.nn.Parameter(torch.zeros(3))
    with pytest.raises(ValueError, match="run on 2 processes, this one has 1.*--nproc-per-node 2"):
        fit(
            [x],
            lambda *_: x.square().sum(),
            CONFIG,
            generator=torch.Generator(),
            checkpoint=tmp_path / "whole.safetensors",
        )


def test_a_training_command_runs_on_two_processes(tmp_path):
    sizes = ["--network.width", "32", "--network.depth", "2", "--network.rank", "30"]
    steps = ["--fit.steps", "4", "--watch-every", "2", "--batch", "4", "--random-batch", "4"]
    command = ["-m", "workbench", "train", "subspace", "--out", "out", *sizes, *steps]
    done = torchrun(tmp_path, *command)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "out" / "tshirt-subspace.safetensors").is_file()
    curves = (tmp_path / "out" / "work" / "tshirt-subspace" / "curves.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in curves] == [2, 4]
