"""Trained networks on disk.  parameters, what they are -> one safetensors file <-> the same; nothing is unpickled.

Matrices are float16.  Vectors stay float32: the mean of a garment, a metre and a half above the floor, would be off by
half a millimetre (measured: 0.22 mm on average over decoded garments).  A tall matrix whose product averages its
rounding away, as that of an encoder's input, may be named to be int8 with a step a column.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from workbench.store import atomic_write

STEPS = ".steps"  # after the name of an int8 matrix: its columns' steps


@dataclass(frozen=True)
class NetworkFile:
    """What a file holds: float32 tensors by parameter name, and words about them."""

    tensors: dict[str, Tensor]
    metadata: dict[str, str]


def write_network(
    network: nn.Module, path: Path, metadata: Mapping[str, str], coarse: Collection[str] = frozenset()
) -> None:
    """Parameters and buffers, whole or not at all; the matrices named in `coarse` as int8."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        if name in coarse and tensor.dim() == 2:
            steps = tensor.abs().amax(dim=0).clamp_min(1e-30) / 127
            tensors[name] = torch.round(tensor / steps).to(torch.int8).contiguous()
            tensors[name + STEPS] = steps.contiguous()
        else:
            tensors[name] = _compact(tensor.detach()).contiguous()
    with atomic_write(path) as part:
        save_file(tensors, part, metadata=dict(metadata))


def read_network(path: Path, remedy: str) -> NetworkFile:
    """Read `write_network`'s file.  ValueError for a damaged one, ending in `remedy`; FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no trained network {path}; {remedy}")
    try:
        with safe_open(path, framework="pt") as file:
            stored = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118  not a dict
            steps = {key: stored.pop(key) for key in list(stored) if key.endswith(STEPS)}
            whole = {
                key: tensor * steps[key + STEPS] if key + STEPS in steps else tensor for key, tensor in stored.items()
            }
            return NetworkFile(whole, file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise ValueError(f"network {path} is damaged ({error}); {remedy}") from error


def _compact(tensor: Tensor) -> Tensor:
    return tensor.half() if tensor.dim() > 1 else tensor.float()
