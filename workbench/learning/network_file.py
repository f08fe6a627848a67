"""Trained networks on disk.  parameters, what they are -> one safetensors file <-> the same; nothing is unpickled.

Matrices are float16.  Vectors stay float32: the mean of a garment, a metre and a half above the floor, would be off by
half a millimetre (measured: 0.22 mm on average over decoded garments).  A matrix whose product averages its rounding
away, as that of an encoder's input or the small components of a basis, may be named to be int8 with a step a column.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from workbench.learning.parallel import processes
from workbench.store import atomic_write

STEPS, FIRST = ".steps", ".first"  # after the name of an int8 matrix: its columns' steps, and rows that stayed float16


@dataclass(frozen=True)
class NetworkFile:
    """What a file holds: float32 tensors by parameter name, and words about them."""

    tensors: dict[str, Tensor]
    metadata: dict[str, str]


def write_network(
    network: nn.Module,
    path: Path,
    metadata: Mapping[str, str],
    coarse: Mapping[str, int] = MappingProxyType({}),
    beside: Mapping[str, Tensor] = MappingProxyType({}),
) -> None:
    """Parameters and buffers, whole or not at all; matrices named in `coarse` as int8, but for so many first rows.

    `beside`: what else the file is to hold, as it is.

    Under torchrun the first process writes, and all wait until it has.
    """
    tensors = {name: tensor.contiguous() for name, tensor in beside.items()}
    for name, parameter in network.state_dict().items():
        tensor = parameter.detach().cpu()
        if name in coarse and tensor.dim() == 2:
            first, rest = tensor[: coarse[name]], tensor[coarse[name] :]
            steps = _short(rest.abs().amax(dim=0).clamp_min(1e-30) / 127)
            tensors[name] = torch.round(rest / steps).to(torch.int8).contiguous()
            tensors[name + STEPS] = steps.contiguous()
            if len(first):
                tensors[name + FIRST] = _compact(first).contiguous()
        else:
            tensors[name] = _compact(tensor).contiguous()
    team = processes()
    if team.first:
        with atomic_write(path) as part:
            save_file(tensors, part, metadata=dict(metadata))
    team.wait()


def read_network(path: Path, remedy: str) -> NetworkFile:
    """Read `write_network`'s file.  ValueError for a damaged one, ending in `remedy`; FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no trained network {path}; {remedy}")
    try:
        with safe_open(path, framework="pt") as file:
            stored = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118  not a dict
            parts = {key: stored.pop(key) for key in list(stored) if key.endswith((STEPS, FIRST))}
            return NetworkFile({key: _whole(key, t, parts) for key, t in stored.items()}, file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise ValueError(f"network {path} is damaged ({error}); {remedy}") from error


def _short(steps: Tensor) -> Tensor:
    """Rounded up to 4 binary digits: times an int8 that is exact in float16, in which the kernels compute."""
    mantissa, exponent = torch.frexp(steps)
    return torch.ldexp((16 * mantissa).ceil() / 16, exponent)


def _whole(name: str, tensor: Tensor, parts: Mapping[str, Tensor]) -> Tensor:
    if name + STEPS not in parts:
        return tensor
    rest = tensor * parts[name + STEPS]
    return torch.cat([parts[name + FIRST], rest]) if name + FIRST in parts else rest


def _compact(tensor: Tensor) -> Tensor:
    return tensor.half() if tensor.dim() > 1 else tensor.float()
