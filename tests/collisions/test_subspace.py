"""Laws of the generative subspace (Eq. 13-16), on a small made-up training set of the T-shirt."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.collisions.body_sdf import BodySDF
from workbench.collisions.canonical_set import CanonicalSequence, CanonicalSet
from workbench.collisions.subspace import (
    LATENTS,
    Decoder,
    LossWeights,
    NetworkConfig,
    Statistics,
    Subspace,
    SubspaceTraining,
    TrainSubspaceConfig,
    collision_loss,
    kl_loss,
    laplacian_loss,
    reconstruction_loss,
    run,
)
from workbench.garments import Garment
from workbench.geometry.laplacian import umbrella_laplacian
from workbench.learning.fit import FitConfig
from workbench.learning.scalar_log import read_curves

SMALL = NetworkConfig(width=32, depth=2, rank=30)


class Ball(BodySDF):
    """Distance to a ball of radius 1."""

    def __call__(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N"]:
        return points.norm(dim=-1) - 1.0


def made_up_set(frames: int = 40) -> CanonicalSet:
    garment = Garment.load("tshirt")
    generator = torch.Generator().manual_seed(0)
    smooth = torch.sin(garment.vertices[None] * torch.rand(30, 1, 3, generator=generator) * 9)
    rows = torch.linalg.qr(smooth.flatten(1).T).Q.T
    basis = (rows * len(garment.vertices) ** 0.5).unflatten(1, (-1, 3))

    def sequence(seed: int, split: str) -> CanonicalSequence:
        chance = torch.Generator().manual_seed(seed)
        return CanonicalSequence(
            coefficients=0.01 * torch.randn(frames, 30, generator=chance),
            rotations=torch.eye(3).expand(frames, 31, 3, 3).clone(),
            translation=torch.zeros(frames, 3),
            betas=torch.randn(10, generator=chance),
            valid=torch.ones(frames, dtype=torch.bool),
            motion_name=f"walk_{seed}",
            split=split,
        )

    sequences = (sequence(1, "train"), sequence(2, "train"), sequence(3, "validation"))
    return CanonicalSet("tshirt", garment.vertices, basis, sequences, 30.0, 0.0)


@pytest.fixture(scope="module")
def small_config(tmp_path_factory) -> TrainSubspaceConfig:
    path = tmp_path_factory.mktemp("set") / "set.npz"
    made_up_set().save(path)
    fit = FitConfig(steps=6, learning_rate=1e-3, warmup=1, checkpoint_every=3)
    return TrainSubspaceConfig(data=path, network=SMALL, batch=4, random_batch=4, fit=fit, watch_every=3)


def test_perfect_reconstruction_costs_nothing():
    garment = Garment.load("tshirt")
    X = garment.vertices[None]
    laplacian = umbrella_laplacian(garment.faces, len(garment.vertices))
    assert reconstruction_loss(X, X) == 0
    assert laplacian_loss(X, X, laplacian) == 0


def test_laplacian_is_blind_to_moving_the_whole_garment():
    garment = Garment.load("tshirt")
    X = garment.vertices[None]
    laplacian = umbrella_laplacian(garment.faces, len(garment.vertices))
    moved = X + torch.tensor([0.1, -0.2, 0.3])
    assert float(laplacian_loss(X, moved, laplacian)) < 1e-3
    assert float(reconstruction_loss(X, moved)) == pytest.approx(200.0, rel=1e-4)


def test_collision_term_is_the_mean_hinge_and_pushes_outwards():
    points = torch.tensor([[[0.9, 0.0, 0.0], [0.0, 1.001, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]], requires_grad=True)
    loss = collision_loss(Ball(), points, 0.002)
    assert float(loss.detach()) == pytest.approx(1e3 * (0.102 + 0.001) / 4, rel=1e-3)
    (gradient,) = torch.autograd.grad(loss, points)
    assert gradient[0, 0, 0] < 0 and gradient[0, 1, 1] < 0
    assert gradient[0, 2:].abs().max() == 0


def test_kl_vanishes_for_the_standard_normal_only():
    zero = torch.zeros(3, LATENTS)
    assert kl_loss(zero, zero) == 0
    assert kl_loss(zero + 0.1, zero) > 0
    assert kl_loss(zero, zero - 1) > 0


def test_both_decoders_start_near_the_mean_garment():
    data = made_up_set()
    for network in (SMALL, replace(SMALL, rank=0)):
        subspace = Subspace("tshirt", Statistics.of(data, network), network)
        with torch.no_grad():
            X = subspace.decode(torch.zeros(2, LATENTS))
            assert X.shape == (2, 4630, 3)
            assert float((X - data.mean).norm(dim=-1).mean()) < 0.05
            assert subspace.encode(X).shape == (2, LATENTS)


def test_latents_start_as_whitened_components():
    """The 2-core form begins as principal component analysis: frames come back but for what 25 components leave."""
    data = made_up_set()
    subspace = Subspace("tshirt", Statistics.of(data, SMALL), SMALL)
    X = data.garments(data.kept("train")[:8])
    with torch.no_grad():
        back = subspace.decode(subspace.encode(X))
    assert float((back - X).norm(dim=-1).mean()) < 0.6 * float((X - data.mean).norm(dim=-1).mean())


def test_training_lowers_the_loss_and_pushes_samples_out_of_the_body(small_config, tmp_path):
    config = replace(
        small_config,
        out=tmp_path,
        fit=FitConfig(steps=60, learning_rate=3e-3, warmup=5),
        weights=LossWeights(collision=200.0),
        watch_every=10,
    )
    run(config)
    curves = read_curves(tmp_path / "work" / "tshirt-subspace" / "curves.jsonl")
    assert curves[-1]["loss"] < curves[0]["loss"]
    assert curves[-1]["samples inside, %"] < curves[0]["samples inside, %"]


def test_self_supervision_is_what_frees_the_samples(small_config):
    """The same step with the second term of Eq. 16 has a gradient on the decoder that the first alone lacks."""
    generator = torch.Generator().manual_seed(0)
    losses = {}
    for supervised in (False, True):
        weights = LossWeights(self_supervised=supervised, collision=100.0)
        training = SubspaceTraining.of(replace(small_config, weights=weights))
        generator.manual_seed(0)
        losses[supervised] = float(training.step(0, generator))
    assert losses[True] > losses[False]


def test_a_killed_training_continues_to_the_same_result(small_config, tmp_path):
    whole = run(replace(small_config, out=tmp_path / "whole"))
    import workbench.collisions.subspace as module

    class Killed(Exception):
        pass

    real, calls = module.measure, []

    def dies(training, *rest):
        calls.append(1)
        if len(calls) == 2:
            raise Killed
        return real(training, *rest)

    module.measure = dies
    try:
        with pytest.raises(Killed):
            run(replace(small_config, out=tmp_path / "cut"))
    finally:
        module.measure = real
    resumed = run(replace(small_config, out=tmp_path / "cut"))
    for name, tensor in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], tensor, atol=1e-6, rtol=1e-5)
    steps = [entry["step"] for entry in resumed.story["curves"]]
    assert steps == sorted(set(steps))


def test_round_trip_on_disk_keeps_the_garments(tmp_path):
    data = made_up_set()
    subspace = Subspace("tshirt", Statistics.of(data, SMALL), SMALL).eval()
    subspace.story = {"curves": [{"step": 1, "loss": 2.0}]}
    subspace.save(tmp_path / "s.safetensors")
    back = Subspace.load(tmp_path / "s.safetensors")
    latent = torch.randn(4, LATENTS, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        assert float((back.decode(latent) - subspace.decode(latent)).norm(dim=-1).mean()) < 1e-3
    assert back.story == subspace.story


def test_the_published_form_comes_back_from_disk(tmp_path):
    data, dense = made_up_set(), replace(SMALL, rank=0)
    subspace = Subspace("tshirt", Statistics.of(data, dense), dense)
    subspace.save(tmp_path / "s.safetensors")
    back = Subspace.load(tmp_path / "s.safetensors")
    for name, tensor in subspace.named_buffers():
        torch.testing.assert_close(dict(back.named_buffers())[name], tensor, msg=name)


def test_wrong_garments_and_latents_are_refused():
    data = made_up_set()
    subspace = Subspace("tshirt", Statistics.of(data, SMALL), SMALL)
    with pytest.raises(ValueError, match=r"12 vertices, but the subspace of 'tshirt' 4630"):
        subspace.encode(torch.zeros(1, 12, 3))
    with pytest.raises(ValueError, match="a latent has 25 numbers, got 7"):
        subspace.decode(torch.zeros(2, 7))


def test_a_damaged_or_foreign_file_is_refused(tmp_path):
    path: Path = tmp_path / "s.safetensors"
    with pytest.raises(FileNotFoundError, match="workbench train subspace"):
        Subspace.load(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="is damaged"):
        Subspace.load(path)


def test_a_set_of_another_garment_is_refused(small_config, tmp_path):
    data = made_up_set()
    foreign = replace(data, garment_name="dress")
    foreign.save(tmp_path / "dress.npz")
    with pytest.raises(ValueError, match="4630 vertices, but garment 'dress'"):
        SubspaceTraining.of(replace(small_config, data=tmp_path / "dress.npz"))


def test_codes_of_training_frames_are_white():
    """What random garments are drawn from is where the real ones lie."""
    data = made_up_set()
    subspace = Subspace("tshirt", Statistics.of(data, SMALL), SMALL)
    frames = data.garments(data.kept("train"))
    codes = subspace.encode(frames)
    torch.testing.assert_close(codes.std(0), torch.ones(LATENTS), atol=1e-3, rtol=0)


def test_codes_give_back_what_lies_in_the_components_where_the_network_adds_nothing():
    data = made_up_set()
    subspace = Subspace("tshirt", Statistics.of(data, SMALL), SMALL)
    assert isinstance(subspace.decoder, Decoder)
    torch.nn.init.zeros_(subspace.decoder.amounts.weight)
    codes = torch.randn(5, LATENTS, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(subspace.encode(subspace.decode(codes)), codes, atol=1e-4, rtol=0)
    assert float(subspace.decode_watched(codes)[1]) < 0.02  # of the root that keeps its gradient finite


def test_departure_is_how_far_vertices_are_off_the_linear_garment():
    data = made_up_set()
    subspace = Subspace("tshirt", Statistics.of(data, SMALL), SMALL)
    codes = torch.randn(5, LATENTS, generator=torch.Generator().manual_seed(0))
    decoder = subspace.decoder
    assert isinstance(decoder, Decoder)
    garments, departed = subspace.decode_watched(codes)
    torch.testing.assert_close(garments, subspace.decode(codes))
    linear = decoder.mixed(codes, torch.zeros(5, len(decoder.basis)))
    off = 1e3 * (garments - linear).square().sum(-1).mean(-1).sqrt().mean()
    torch.testing.assert_close(departed, off, atol=1e-3, rtol=1e-3)
