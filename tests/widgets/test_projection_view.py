"""Projection: the four views of Fig. 3 are the simulation, both baselines and ours, marked by exact counts."""

import numpy as np
import pytest
import torch

from widgets.projection_view import ProjectionComparison, jitter
from widgets.view import view
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import penetration
from workbench.collisions.projection import Projector
from workbench.collisions.projection_baselines import constant_weights
from workbench.collisions.sequences import shipped_sequence
from workbench.garments import Garment
from workbench.geometry.strain import rest_triangles


@pytest.fixture(scope="module")
def sequence():
    return shipped_sequence("tshirt_walk")


@pytest.fixture(scope="module")
def projector(body):
    garment = Garment.load("tshirt")
    rest = rest_triangles(garment.rest_vertices, garment.faces)
    return Projector(GarmentModel(body, GridFields.default()), GridSDF.default(), rest, garment.vertices)


@pytest.fixture(scope="module")
def compared(projector, sequence):
    return ProjectionComparison.of(projector, sequence, frames=3, start=30)


def test_views_show_simulation_baselines_and_ours(body, compared, sequence):
    panel = view(compared)
    shown = [panel.layer("garment", index).vertices for index in range(4)]
    moved = panel.layer("body").vertices - compared.bodies.numpy()
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:, :1], moved.shape), atol=1e-6)
    np.testing.assert_allclose(shown[0] - moved[:, :1], sequence.garment[30:33].numpy(), atol=1e-6)
    for index, X in ((1, compared.constant), (2, compared.nearest), (3, compared.ours.canonical)):
        np.testing.assert_array_equal(shown[index], X.numpy())
        exact = penetration(body.template[None], body.faces, X).inside.numpy()
        np.testing.assert_array_equal(panel.layer("garment", index).marked, exact)
        assert f"{100 * exact.mean():.2f} % inside" in panel.scene.views[index].title
    np.testing.assert_allclose(panel.layer("garment", 3).choices[0].values, 1e3 * compared.ours.error.numpy())


def test_ours_is_free_where_constant_weights_are_not(compared):
    panel = view(compared)
    assert panel.layer("garment", 3).marked.sum() == 0
    assert panel.layer("garment", 1).marked.sum() > 0
    assert "jitter" in panel.readout


def test_baseline_is_the_stage_s(projector, compared, sequence):
    kept = slice(30, 33)
    state = projector.model.state(sequence.rotations[kept], sequence.betas, sequence.translation[kept])
    expected = constant_weights(projector.model.body, projector.template, sequence.garment[kept], state)
    torch.testing.assert_close(compared.constant, expected)


def test_jitter_is_the_second_difference():
    steady = torch.arange(5.0)[:, None, None].expand(5, 2, 3) * 0.1
    assert jitter(steady) == pytest.approx(0, abs=1e-4)
    shaken = steady.clone()
    shaken[2, :, 0] += 0.001
    assert jitter(shaken) == pytest.approx((1 + 2 + 1) / 3, rel=1e-3)
    assert jitter(steady[:2]) == 0


def test_frames_that_are_not_there_are_told(projector, sequence):
    with pytest.raises(ValueError, match="none from 999 on"):
        view(projector, sequence, start=999)


def test_a_projector_shows_frames_of_a_shipped_walk(projector):
    panel = view(projector, frames=1)
    assert panel.scene.frames == 1
    assert len(panel.scene.views) == 4


def test_a_sequence_is_played_with_its_marks(body, sequence):
    clip = sequence.clip(0, 3)
    panel = view(clip)
    bodies = body.vertices(clip.rotations, clip.betas, clip.translation)
    np.testing.assert_array_equal(panel.layer("garment").vertices, clip.garment.numpy())
    np.testing.assert_array_equal(
        panel.layer("garment").marked, penetration(bodies, body.faces, clip.garment).inside.numpy()
    )
    assert panel.scene.fps == clip.fps
