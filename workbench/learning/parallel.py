"""Training on several processes: `torchrun --nproc-per-node N -m workbench train ...`.  rank, count -> mean gradients.

Each process draws its own batches; gradients are averaged, so a step of N processes is a step of an N times larger
batch.  Files are written by the first process alone, into folders that all of them see.
"""

import atexit
import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch import distributed as group

SEED_STEP = 1_000_003  # between the seeds of two processes


@dataclass(frozen=True)
class Processes:
    """Which of how many processes this one is; one alone where torchrun did not start it."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.rank == 0

    def own_chance(self, generator: torch.Generator) -> None:
        """Give each process but the first another seed, in place."""
        if not self.first:
            generator.manual_seed(generator.initial_seed() + SEED_STEP * self.rank)

    def wait(self) -> None:
        """Until all processes have come here."""
        if self.count > 1:
            group.barrier()

    def share(self, parameters: Sequence[Tensor]) -> None:
        """The first process's values for all, in place."""
        if self.count > 1:
            for parameter in parameters:
                group.broadcast(parameter.data, src=0)

    def average(self, parameters: Sequence[Tensor], loss: Tensor) -> float:
        """Mean over the processes of the gradients, in place, and of the loss."""
        if self.count == 1:
            return float(loss.detach())
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([*(gradient.flatten() for gradient in gradients), loss.detach().reshape(1).to(gradients[0])])
        group.all_reduce(flat)
        flat /= self.count
        parts = flat[:-1].split([gradient.numel() for gradient in gradients])
        for parameter, part in zip(parameters, parts, strict=True):
            parameter.grad = part.view_as(parameter).clone()
        return float(flat[-1])

    def chances(self, generator: torch.Generator) -> list[Tensor]:
        """The states of all processes' generators."""
        own = generator.get_state()
        if self.count == 1:
            return [own]
        states = [torch.empty_like(own) for _ in range(self.count)]
        group.all_gather(states, own)
        return states


def processes() -> Processes:
    """Those that torchrun started, which meet at the first call; one alone without it.

    What lies on GPUs is exchanged by NCCL, what lies on the CPU (all generators) by gloo.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Processes()
    if not group.is_initialized():
        with_gpus = torch.cuda.is_available() and group.is_nccl_available()
        group.init_process_group("cpu:gloo,cuda:nccl" if with_gpus else "gloo")
        atexit.register(_leave)
    return Processes(group.get_rank(), group.get_world_size())


def _leave() -> None:
    """Leave the group while Python still runs: gloo's threads may hold tensors, and letting those go later aborts.

    One run in CI ended with SIGABRT: taken for pytorch/pytorch#179291, as it did not happen again in 75 runs.
    """
    if group.is_initialized():
        group.destroy_process_group()
