"""Fully connected networks of the papers.  x (*B,in) -> (*B,out)."""

import math
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from workbench.learning.network_file import read_network, write_network


class MLP(nn.Module):
    """Dense layers with ReLU between them and a linear last one: in -> hidden x depth -> out."""

    def __init__(self, inputs: int, outputs: int, *, width: int = 256, depth: int = 5, generator: torch.Generator):
        super().__init__()
        sizes = [inputs, *[width] * depth, outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Float[Tensor, "*B i"]) -> Float[Tensor, "*B o"]:
        *hidden, last = self.layers
        for layer in hidden:
            x = torch.relu(layer(x))
        return last(x)


class Siren(nn.Module):
    """Sine layers, sin(omega (W x + b)), and a linear last one (Sitzmann et al. 2020, with their initialisation)."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        width: int = 256,
        depth: int = 5,
        omega: float = 30.0,
        generator: torch.Generator,
    ):
        super().__init__()
        sizes = [inputs, *[width] * depth, outputs]
        self.omega = omega
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, nn.Linear)
            fan_in = layer.in_features
            bound = 1 / fan_in if index == 0 else math.sqrt(6 / fan_in) / omega
            nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
            nn.init.uniform_(layer.bias, -1 / math.sqrt(fan_in), 1 / math.sqrt(fan_in), generator=generator)

    def forward(self, x: Float[Tensor, "*B i"]) -> Float[Tensor, "*B o"]:
        *hidden, last = self.layers
        for layer in hidden:
            x = torch.sin(self.omega * layer(x))
        return last(x)


def parameter_count(module: nn.Module) -> int:
    """How many numbers a network learns."""
    return sum(parameter.numel() for parameter in module.parameters())


def save_network(network: nn.Module, path: Path, *, kind: str, fingerprint: str) -> None:
    """Write the parameters with what they are (`kind`) and what they were made for (`fingerprint`)."""
    write_network(network, path, {"kind": kind, "made_for": fingerprint})


def load_network(network: nn.Module, path: Path, *, kind: str, fingerprint: str) -> None:
    """Fill `network` from `save_network`'s file.  ValueError for a missing, damaged or foreign file."""
    try:
        found = read_network(path, "make it with `workbench train fields`")
    except FileNotFoundError as error:
        raise ValueError(str(error)) from error
    metadata, tensors = found.metadata, found.tensors
    if metadata.get("kind") != kind:
        raise ValueError(f"network {path} is a {metadata.get('kind')!r} network, expected {kind!r}")
    if metadata.get("made_for") != fingerprint:
        raise ValueError(
            f"network {path} was trained for another body ({metadata.get('made_for')}, this one is {fingerprint}); "
            "train it for this body with `workbench train fields`"
        )
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    if found != expected:
        wrong = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))[0]
        raise ValueError(f"network {path}: {wrong} has shape {found.get(wrong)}, expected {expected.get(wrong)}")
    network.load_state_dict(tensors)
