"""Laws of networks on disk."""

import pytest
import torch
from torch import nn

from workbench.learning.network_file import read_network, write_network


def test_vectors_come_back_exactly_and_matrices_within_half_precision(tmp_path):
    network = nn.Linear(7, 5)
    with torch.no_grad():
        network.bias.add_(1.6)  # metres above the floor: half precision would be off by half a millimetre
    write_network(network, tmp_path / "n.safetensors", {"kind": "test"})
    back = read_network(tmp_path / "n.safetensors", "train it")
    assert torch.equal(back.tensors["bias"], network.bias)
    torch.testing.assert_close(back.tensors["weight"], network.weight, rtol=1e-3, atol=1e-6)
    assert back.metadata == {"kind": "test"}


def test_missing_and_damaged_files_say_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="no trained network .*; train it"):
        read_network(tmp_path / "none.safetensors", "train it")
    (tmp_path / "bad.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match="is damaged .*; train it"):
        read_network(tmp_path / "bad.safetensors", "train it")
