"""The networks in kernels: what torch gives, for networks as files hold them."""

from dataclasses import replace

import pytest
import torch

from workbench.collisions.limb_sight import LimbSight
from workbench.collisions.posed_corrective import PosedCorrective
from workbench.collisions.regressor import Regressor
from workbench.collisions.subspace import NetworkConfig, Statistics, Subspace
from workbench.collisions.tryon import TorchNetworks, TryOn
from workbench.collisions.tryon_kernels import KernelCorrective, KernelNetworks, quickest
from workbench.collisions.tryon_onnx import OnnxNetworks
from workbench.extras import MissingExtra
from workbench.formats import load_motion, motion_files
from workbench.geometry.patches import Patches


@pytest.fixture(scope="module")
def tryon() -> TryOn:
    return TryOn.shipped("tshirt")


def test_each_network_gives_what_torch_gives(tryon):
    one, two = TorchNetworks(tryon.regressor, tryon.subspace), KernelNetworks(tryon.regressor, tryon.subspace)
    chance = torch.Generator().manual_seed(0)
    ours = theirs = torch.zeros(2, 1, 500)
    with torch.no_grad():
        for _ in range(20):
            inputs = torch.randn(52, generator=chance)
            wanted, theirs = one.regress(inputs, theirs)
            found, ours = two.regress(inputs, ours)
            torch.testing.assert_close(found, wanted, atol=2e-5, rtol=1e-4)
            torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)
            latent = torch.randn(25, generator=chance)
            torch.testing.assert_close(two.decode(latent), one.decode(latent), atol=1e-5, rtol=0)  # metres


def test_a_stream_on_kernels_is_within_ten_micrometres_of_one_in_torch(tryon):
    motion = load_motion(motion_files(None)[0], tryon.model.body).clip(0, 30)
    betas = torch.linspace(-1, 1, 10)
    slow, fast = tryon.stream(betas), replace(tryon, networks=KernelNetworks(tryon.regressor, tryon.subspace))
    fast = fast.stream(betas)
    for r, h in zip(motion.rotations, motion.translation, strict=True):
        apart = fast(r, h).garment - slow(r, h).garment
        assert float(apart.norm(dim=-1).max()) < 1e-5


def test_a_result_outlives_the_next_frame(tryon):
    networks = KernelNetworks(tryon.regressor, tryon.subspace)
    latent, hidden = networks.regress(torch.ones(52), torch.zeros(2, 1, 500))
    X = networks.decode(torch.ones(25))
    kept = [latent.clone(), hidden.clone(), X.clone()]
    networks.regress(-torch.ones(52), torch.ones(2, 1, 500))
    networks.decode(-torch.ones(25))
    for now, before in zip((latent, hidden, X), kept, strict=True):
        assert torch.equal(now, before)


def test_networks_that_float16_cannot_hold_are_refused(tryon):
    fresh = Regressor("tshirt", 31, 10, 30.0, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"weight_ih_l0 is not exact in float16.*save and load"):
        KernelNetworks(fresh, tryon.subspace)


def test_a_dense_decoder_is_refused(tryon):
    config = NetworkConfig(width=8, depth=1, rank=0)
    dense = Subspace("tshirt", Statistics.blank(tryon.subspace.vertex_count, config), config)
    with pytest.raises(ValueError, match="no dense last layer"):
        KernelNetworks(tryon.regressor, dense)


def test_the_quickest_networks_are_those_that_can_be_had(tryon, monkeypatch):
    assert isinstance(quickest(tryon).networks, KernelNetworks)
    fresh = replace(tryon, regressor=Regressor("tshirt", 31, 10, 30.0, torch.Generator().manual_seed(0)))
    assert isinstance(quickest(fresh).networks, OnnxNetworks)

    def absent(regressor, subspace):
        raise MissingExtra("no onnxruntime")

    monkeypatch.setattr("workbench.collisions.tryon_kernels.OnnxNetworks", absent)
    assert quickest(fresh).networks is fresh.networks


@pytest.mark.parametrize("name", ["tshirt", "dress"])
def test_what_ships_runs_in_kernels(name):
    fast = quickest(TryOn.shipped(name))
    assert isinstance(fast.corrective, KernelCorrective)
    assert isinstance(fast.networks, KernelNetworks)


def test_a_corrective_that_has_to_run_in_torch_says_so(tryon, caplog):
    patches = Patches.of(tryon.garment.vertices, 12)
    sight = LimbSight.of(tryon.model.body, tryon.model.fields, patches.centres(tryon.garment.vertices))
    basis = torch.randn(16, 3 * patches.vertices.numel(), generator=torch.Generator().manual_seed(2))
    fresh = replace(tryon, corrective=PosedCorrective("tshirt", patches, sight, basis, 64))
    with caplog.at_level("WARNING"):
        assert quickest(fresh).corrective is fresh.corrective
    assert "runs in torch, slowly: the corrective's basis is not exact in float16" in caplog.text


@pytest.mark.parametrize("size", [5, 500])  # 500: far beyond its reach
def test_a_corrective_in_kernels_gives_what_torch_gives(tryon, size):
    chance = torch.Generator().manual_seed(2)
    patches = Patches.of(tryon.garment.vertices, 12)
    basis = size * torch.randn(16, 3 * patches.vertices.numel(), generator=chance)
    sight = LimbSight.of(tryon.model.body, tryon.model.fields, patches.centres(tryon.garment.vertices))
    corrective = PosedCorrective("tshirt", patches, sight, basis, 64, chance)
    with torch.no_grad():
        for parameter in corrective.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=chance)
            parameter.copy_(parameter.half().float())
    slow = replace(tryon, corrective=corrective)
    fast = quickest(slow)
    assert isinstance(fast.corrective, KernelCorrective)
    motion = load_motion(motion_files(None)[0], tryon.model.body).clip(0, 12)
    betas = torch.linspace(-1, 1, 10)
    one, two = slow.stream(betas), fast.stream(betas)
    for r, h in zip(motion.rotations, motion.translation, strict=True):
        torch.testing.assert_close(two(r, h).canonical, one(r, h).canonical, atol=1e-5, rtol=0)
    plain = tryon.stream(betas)(motion.rotations[0], motion.translation[0]).canonical
    assert float((fast.stream(betas)(motion.rotations[0], motion.translation[0]).canonical - plain).abs().max()) > 1e-3
    whole = fast.run(motion, betas)
    torch.testing.assert_close(whole.canonical, slow.run(motion, betas).canonical)
