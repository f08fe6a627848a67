"""Eq. 7: only G moves, and it finds what it should; the baseline by skinning is exact where nothing moves."""

from dataclasses import replace

import pytest
import torch

from workbench.geometry.mesh import vertex_normals
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning.fit import FitConfig
from workbench.points.clothed_points import clothed
from workbench.points.scan_fitting import FittedOutfit, ScanFitConfig, features_of, fit_scan, lbs_of_scan
from workbench.points.scans import ScanFrame
from workbench.points.uv_position_map import atlas_of, posed_bodies, posed_queries

CONFIG = ScanFitConfig(
    fit=FitConfig(steps=40, learning_rate=0.05, last_rate=0.01, warmup=2, clip_norm=1e9, checkpoint_every=10**9),
    queries=400,
    scan_points=1500,
    query_size=48,
)


def frame_of(body, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rotations = axis_angle_to_matrix(0.15 * torch.randn(1, len(body.parents), 3, generator=generator))
    return posed_bodies(body, rotations, body.mean_shape())


def skin_of(body, bodies):
    return ScanFrame(bodies.vertices[0], vertex_normals(bodies.vertices[0], body.faces))


def test_a_cloud_of_the_model_s_own_is_found_again(body, small_model, trained_like, tmp_path):
    """The scan is what the model makes of a G between two outfits: the loss falls to a fraction; networks stay."""
    model, bodies = trained_like(small_model), frame_of(body)
    with torch.no_grad():
        model.geometry.stored.mul_(300)  # outfits that differ
        atlas = atlas_of(body, 48)
        posed = posed_queries(atlas.queries, bodies)
        between = model.geometry.smooth(0.8 * model.geometry.tensors[:1] - 0.6 * model.geometry.tensors[1:2])
        pose = model.encoder(atlas_of(body, 32).map_of(bodies.neutral))
        cloud = clothed(posed, model.decode(atlas.queries.u, pose, between))
    scan = ScanFrame(cloud.points[0], cloud.normals[0])
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    fitted, _ = fit_scan(model, body, scan, bodies, CONFIG, betas=body.mean_shape(), name="own")
    assert fitted.loss_after < 0.7 * fitted.loss_before
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())
    assert all(parameter.requires_grad for parameter in model.parameters())
    again, _ = fit_scan(model, body, scan, bodies, CONFIG, betas=body.mean_shape(), name="own")
    assert torch.equal(again.G, fitted.G)
    fitted.save(tmp_path / "f.npz")
    read = FittedOutfit.load(tmp_path / "f.npz")
    assert (read.name, read.loss_after) == ("own", fitted.loss_after)
    torch.testing.assert_close(features_of(model, read), features_of(model, fitted), atol=1e-2, rtol=1e-2)
    assert torch.equal(read.betas, body.mean_shape())
    with torch.no_grad():
        model.decoder.to_normal.bias += 1
    with pytest.raises(ValueError, match="was fitted with other networks"):
        features_of(model, read)


def test_it_begins_at_the_outfit_that_is_nearest(body, small_model, trained_like):
    """The scan is an outfit that the model knows: no step is needed to be there."""
    model, bodies = trained_like(small_model), frame_of(body)
    with torch.no_grad():
        model.geometry.stored.mul_(300)
        atlas = atlas_of(body, 48)
        posed = posed_queries(atlas.queries, bodies)
        cloud = model(atlas_of(body, 32).map_of(bodies.neutral), torch.tensor([1]), posed)
    scan = ScanFrame(cloud.points[0], cloud.normals[0])
    still = replace(
        CONFIG,
        weights=replace(CONFIG.weights, geometry=0.0),
        fit=replace(CONFIG.fit, steps=1, learning_rate=1e-12, last_rate=1e-12),
    )
    fitted, _ = fit_scan(model, body, scan, bodies, still, betas=body.mean_shape())
    torch.testing.assert_close(fitted.G, model.geometry.tensors[1:2].detach(), atol=1e-9, rtol=1e-6)


def test_a_scan_that_is_elsewhere_is_refused(body, small_model):
    bodies = frame_of(body)
    skin = skin_of(body, bodies)
    away = ScanFrame(skin.points + torch.tensor([0.0, 0.0, 0.9]), skin.normals)
    with pytest.raises(ValueError, match=r"the body lies \d+ cm off the scan .*: with --place it"):
        fit_scan(small_model, body, away, bodies, CONFIG, betas=body.mean_shape())


def test_skinning_a_scan_of_the_bare_body_gives_the_posed_body(body):
    """Points on the body stay on it: its pose correctives, which skinning of a scan lacks, are what is left."""
    worn, posed = frame_of(body, 0), frame_of(body, 1)
    moved = lbs_of_scan(skin_of(body, worn), body, worn, posed)
    torch.testing.assert_close(moved.points, posed.vertices[0], atol=1e-4, rtol=0)
    same = lbs_of_scan(skin_of(body, worn), body, worn, worn)
    torch.testing.assert_close(same.points, worn.vertices[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(moved.normals.norm(dim=-1), torch.ones(len(moved.normals)))


def test_skinning_carries_an_offset_rigidly(body):
    worn, posed = frame_of(body, 0), frame_of(body, 1)
    skin = skin_of(body, worn)
    lifted = ScanFrame(skin.points + 0.01 * skin.normals, skin.normals)
    moved = lbs_of_scan(lifted, body, worn, posed)
    distance = (moved.points - posed.vertices[0]).norm(dim=1)
    assert distance.median() == pytest.approx(0.01, rel=0.05)
