"""Subspace: what is seen is D(x_bar); marked vertices are those inside, by winding number."""

import numpy as np
import pytest
import torch

from widgets.subspace_view import subspace_view
from widgets.view import view
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.penetration import penetration
from workbench.collisions.subspace import Subspace


@pytest.fixture(scope="module")
def subspace():
    return Subspace.shipped("tshirt")


@pytest.fixture(scope="module")
def colliding(subspace):
    """The same decoder, drawn 3 % inwards: parts of the garment come to lie inside the body."""
    other = Subspace.shipped("tshirt")
    with torch.no_grad():
        middle = other.decoder.middle.unflatten(0, (-1, 3))
        middle[:, :2] *= 0.9
    return other


def garment(panel, index=0):
    return panel.layer("garment", index)


def test_what_is_seen_is_decoded(subspace):
    panel = view(subspace)
    latent = torch.linspace(-1, 1, 25)
    panel["latent"] = latent
    with torch.no_grad():
        expected = subspace.decode(torch.tensor(panel["latent"])).numpy()
    np.testing.assert_array_equal(garment(panel).vertices, expected)
    assert panel["latent"] == pytest.approx(latent.tolist())


def test_marked_vertices_are_exactly_those_inside(body, subspace, colliding):
    panel = view(subspace, colliding, names=("shipped", "tight"))
    for seed in (1, 2):
        panel["seed"] = seed
        for index in range(2):
            mesh = garment(panel, index)
            exact = penetration(body.template[None], body.faces, torch.from_numpy(mesh.vertices)[None]).inside[0]
            np.testing.assert_array_equal(mesh.marked, exact.numpy())
            assert f"{int(exact.sum())} of 4,630 inside" in panel.scene.views[index].title
    assert garment(panel, 1).marked.sum() > 10
    assert "tight: " in panel.readout


def test_the_gap_is_the_sdf(subspace):
    panel = view(subspace)
    mesh = garment(panel)
    expected = 1e3 * GridSDF.default()(torch.from_numpy(mesh.vertices)).numpy()
    np.testing.assert_allclose(mesh.choices[0].values, expected, atol=1e-4)


def test_buttons_move_the_sliders_and_the_seed_repeats(subspace):
    panel = view(subspace)
    panel.press("random")
    first = panel["latent"]
    assert panel["seed"] == 1
    panel.press("random")
    assert panel["latent"] != first
    panel["seed"] = 1
    assert panel["latent"] == first
    panel.press("reset")
    assert panel["latent"] == (0.0,) * 25


def test_the_way_between_two_latents_is_straight(subspace):
    panel = view(subspace)
    panel["latent"] = [1.0] + [0.0] * 24
    panel.press("keep as A")
    panel["latent"] = [0.0] * 24 + [2.0]
    panel.press("keep as B")
    panel["A to B"] = 0.5
    assert panel["latent"] == (0.5, *[0.0] * 23, 1.0)
    panel["A to B"] = 1.0
    assert panel["latent"] == (*[0.0] * 24, 2.0)


def test_a_slider_leaves_the_body_and_the_camera(subspace):
    panel = view(subspace)
    camera, body = panel.scene.camera, panel.layer("constant body").vertices
    panel["latent"] = [1.0] * 25
    assert panel.scene.camera == camera
    assert panel.layer("constant body").vertices is body


def test_subspaces_that_do_not_go_together_are_told(subspace, colliding):
    with pytest.raises(ValueError, match="1 names for 2 subspaces"):
        subspace_view(subspace, colliding, names=("one",))
    strange = Subspace.shipped("tshirt")
    strange.garment_name = "dress"
    strange.decoder.middle = torch.nn.Parameter(torch.zeros(30))
    with pytest.raises(ValueError, match="of different garments"):
        subspace_view(subspace, strange)


def test_two_alike_are_numbered(subspace, colliding):
    titles = [v.title for v in view(subspace, colliding).scene.views]
    assert "(1)" in titles[0] and "(2)" in titles[1]
