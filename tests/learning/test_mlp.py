"""Networks: the papers' sizes, derivatives, chance from outside, files."""

import pytest
import torch

from workbench.learning.mlp import MLP, Siren, load_network, parameter_count, save_network


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_sizes_are_those_of_the_papers():
    assert parameter_count(MLP(3, 24, generator=seeded())) == pytest.approx(270_000, rel=0.01)
    assert len(Siren(3, 1, generator=seeded()).layers) == 6


def test_the_generator_decides_the_start():
    for kind in (MLP, Siren):
        one, two, other = (kind(3, 2, width=8, depth=2, generator=seeded(s)) for s in (0, 0, 1))
        x = torch.ones(4, 3)
        assert torch.equal(one(x), two(x))
        assert not torch.equal(one(x), other(x))


def test_derivatives_are_right():
    x = torch.linspace(-0.9, 0.8, 12, dtype=torch.float64).reshape(4, 3).requires_grad_(True)
    for network in (MLP(3, 2, width=8, depth=2, generator=seeded()), Siren(3, 1, width=8, depth=2, generator=seeded())):
        assert torch.autograd.gradcheck(network.double(), (x,))


def test_a_sine_network_starts_with_signals_of_order_one():
    network = Siren(3, 1, generator=seeded())
    x = 2 * torch.rand(2000, 3, generator=seeded()) - 1
    for layer in list(network.layers)[:-1]:
        x = torch.sin(network.omega * layer(x))
        assert 0.4 < x.std() < 0.9


def test_round_trip_through_the_file(tmp_path):
    network, again = MLP(3, 2, width=8, generator=seeded()), MLP(3, 2, width=8, generator=seeded(1))
    save_network(network, tmp_path / "n.safetensors", kind="weights", fingerprint="abc")
    load_network(again, tmp_path / "n.safetensors", kind="weights", fingerprint="abc")
    x = torch.rand(10, 3, generator=seeded())
    torch.testing.assert_close(again(x), network(x), atol=2e-3, rtol=2e-3)


def test_files_that_do_not_fit_are_refused(tmp_path):
    network = MLP(3, 2, width=8, generator=seeded())
    path = tmp_path / "n.safetensors"
    with pytest.raises(ValueError, match="there is no trained network .*workbench train fields"):
        load_network(network, path, kind="weights", fingerprint="abc")
    save_network(network, path, kind="weights", fingerprint="abc")
    with pytest.raises(ValueError, match="is a 'weights' network, expected 'pose'"):
        load_network(network, path, kind="pose", fingerprint="abc")
    with pytest.raises(ValueError, match="trained for another body"):
        load_network(network, path, kind="weights", fingerprint="xyz")
    with pytest.raises(ValueError, match=r"layers.5.bias has shape \(2,\), expected \(3,\)"):
        load_network(MLP(3, 3, width=8, generator=seeded()), path, kind="weights", fingerprint="abc")
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="is damaged"):
        load_network(network, path, kind="weights", fingerprint="abc")
