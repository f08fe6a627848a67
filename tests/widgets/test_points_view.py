"""Clouds: surfels are the points that were given, turned by their normals, coloured by direction, as many as asked."""

import numpy as np
import pytest
import torch

from widgets.points_view import PALETTE, cloud_of, normal_colours, surfels
from widgets.view import view
from workbench.formats.scans import Scan
from workbench.points.clothed_points import PointModel, PointModelConfig
from workbench.points.geometry_features import GeometryFeaturesConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.trained_points import TrainedPoints

SMALL = PointModelConfig(
    encoder=PoseEncoderConfig(depth=4, width=4, features=4),
    geometry=GeometryFeaturesConfig(size=16, features=4),
    decoder=ShapeDecoderConfig(width=16, features=8),
    input_size=16,
)


@pytest.fixture
def sphere(rng):
    normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(900, 3))).float(), dim=-1)
    return ScanFrame(normals * 0.5, normals)


def test_directions_have_colours_of_their_own_and_all_are_unit(rng):
    np.testing.assert_allclose(np.linalg.norm(PALETTE, axis=1), 1)
    coded = normal_colours(PALETTE).values
    np.testing.assert_array_equal(coded, np.arange(len(PALETTE)))
    any_normals = rng.normal(size=(500, 3))
    any_normals /= np.linalg.norm(any_normals, axis=1, keepdims=True)
    shown = PALETTE[normal_colours(any_normals).values.astype(int)]
    assert (shown * any_normals).sum(1).min() > np.cos(np.radians(12))


def test_fewer_surfels_are_larger_and_cover_the_same(sphere):
    few, many = (
        surfels(sphere.points[:100].numpy(), sphere.normals[:100].numpy()),
        surfels(sphere.points.numpy(), sphere.normals.numpy()),
    )
    assert 100 * few.radius**2 == pytest.approx(900 * many.radius**2)


def test_the_density_slider_shows_points_of_the_cloud(sphere):
    panel = view(sphere)
    panel["points"] = 600
    layer = panel.layer("surfels")
    assert layer.positions.shape == (600, 3)
    assert {tuple(p) for p in layer.positions} <= {tuple(p) for p in sphere.points.numpy()}
    np.testing.assert_allclose(layer.normals, 2 * layer.positions, atol=1e-6)
    assert "600 points" in panel.readout


def test_more_points_than_there_are_is_refused(sphere):
    with pytest.raises(ValueError, match="1000 points are asked for of a cloud of 900"):
        cloud_of(sphere, count=1000)


def test_a_scan_of_a_file_is_shown_as_its_frame_is(sphere):
    panel = view(Scan(sphere.points.numpy(), sphere.normals.numpy()))
    np.testing.assert_array_equal(panel.layer("surfels").positions, view(sphere).layer("surfels").positions)


def test_a_sequence_shows_the_frame_that_is_asked_for(sphere, body):
    frames = [sphere, ScanFrame(sphere.points + 0.1, sphere.normals)]
    sequence = ScanSequence.of(
        frames, outfit="ball", motion="hop", rotations=torch.eye(3).expand(2, 22, 3, 3), betas=torch.zeros(10), fps=1.0
    )
    panel = view(sequence)
    before = panel.layer("surfels").positions
    panel["frame"] = 1
    np.testing.assert_allclose(panel.layer("surfels").positions, before + 0.1, atol=1e-4)
    assert panel.scene.views[0].title == "ball, hop"


def test_a_model_is_asked_at_as_many_places_as_wanted(body):
    model = PointModel(2, SMALL, generator=torch.Generator().manual_seed(0)).eval()
    panel = view(TrainedPoints(model, ("gown", "robe")), body=body)
    panel["points"] = 1500
    first = panel.layer("surfels").positions
    panel["outfit"] = "robe"
    assert first.shape == panel.layer("surfels").positions.shape == (1500, 3)
    assert np.abs(first - panel.layer("surfels").positions).max() > 0
