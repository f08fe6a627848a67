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


def test_a_coarse_matrix_keeps_what_its_product_is_for(tmp_path):
    """Thousands of roundings average out: the product is as near as in half precision, from half the bytes."""
    network = nn.Linear(9000, 8, bias=False)
    network.weight.data = network.weight.data * torch.logspace(-4, 2, 8)[:, None]
    turned = nn.Module()
    turned.register_buffer("view", network.weight.detach().T.contiguous())
    write_network(turned, tmp_path / "fine.safetensors", {})
    write_network(turned, tmp_path / "coarse.safetensors", {}, coarse={"view": 0})
    fine, coarse = ((tmp_path / f"{name}.safetensors").stat().st_size for name in ("fine", "coarse"))
    assert coarse < 0.55 * fine
    x = torch.randn(400, 9000, generator=torch.Generator().manual_seed(0))  # with 20 the mean over them strays by half
    wanted = network(x).detach()
    found = x @ read_network(tmp_path / "coarse.safetensors", "train it").tensors["view"]
    assert float(((found - wanted).abs().mean(0) / wanted.std(0)).max()) < 0.005


def test_first_rows_of_a_coarse_matrix_may_stay_fine(tmp_path):
    """As of a basis whose large components come first."""
    basis = torch.randn(40, 500, generator=torch.Generator().manual_seed(0)) * torch.logspace(2, -2, 40)[:, None]
    network = nn.Module()
    network.register_buffer("basis", basis)
    found = {}
    for first in (0, 10):
        write_network(network, tmp_path / "n.safetensors", {}, coarse={"basis": first})
        found[first] = read_network(tmp_path / "n.safetensors", "train it").tensors["basis"]
        assert found[first].shape == basis.shape
        step = basis[first:].abs().amax(0) / 127
        assert ((found[first][first:] - basis[first:]).abs() <= 0.51 * 9 / 8 * step).all()  # steps have 4 digits
        assert torch.equal(found[first].half().float(), found[first])
    torch.testing.assert_close(found[10][:10], basis[:10], rtol=1e-3, atol=0)
    off = {first: float((one - basis).norm()) for first, one in found.items()}
    assert off[10] < 0.1 * off[0]


def test_missing_and_damaged_files_say_what_to_do(tmp_path):
    with pytest.raises(FileNotFoundError, match="no trained network .*; train it"):
        read_network(tmp_path / "none.safetensors", "train it")
    (tmp_path / "bad.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match="is damaged .*; train it"):
        read_network(tmp_path / "bad.safetensors", "train it")
