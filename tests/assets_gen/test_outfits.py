"""Outfits: merged meshes keep their parts, layers start in their order."""

import numpy as np
import pytest
import torch

from assets_gen.garments import OUTFITS
from assets_gen.outfits import ENSEMBLES, LAYER_GAP, Ensemble, Outfit, behind, cleared, merged, put_on
from workbench.garments import Garment


def tube(name, radius, low, high, rows=12, sections=48):
    """An open, upright cylinder as a garment, normals outwards."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    heights = np.linspace(low, high, rows)
    vertices = np.concatenate([np.column_stack([ring, np.full(sections, z)]) for z in heights]).astype(np.float32)
    i = np.arange(sections)
    j, faces = np.roll(i, -1), []
    for row in range(rows - 1):
        a, b, c, d = row * sections + i, row * sections + j, (row + 1) * sections + j, (row + 1) * sections + i
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    points = torch.from_numpy(vertices)
    return Garment(name, points, points, torch.from_numpy(np.concatenate(faces)))


def test_merging_keeps_every_part():
    inner, outer = tube("skirt", 0.2, 0.4, 0.9), tube("shirt", 0.25, 0.7, 1.2)
    outfit = merged("both", [inner, outer])
    for k, garment in enumerate((inner, outer)):
        own = outfit.garment_of_vertex == k
        assert torch.equal(outfit.vertices[own], garment.vertices)
        faces = outfit.faces[own[outfit.faces[:, 0]]]
        assert torch.equal(outfit.vertices[faces], garment.vertices[garment.faces])
        assert own[faces].all()  # no face joins two garments
    assert outfit.garments == ("skirt", "shirt")


def test_a_tight_outer_layer_is_brought_outside():
    inner, outer = tube("skirt", 0.2, 0.4, 0.9), tube("shirt", 0.195, 0.7, 1.2)
    outfit = put_on(Ensemble("both", ("skirt", "shirt")), [inner, outer])
    placed = outfit.vertices[outfit.garment_of_vertex == 1]
    radius, height = placed[:, :2].norm(dim=1), placed[:, 2]
    assert radius[height < 0.9].min() > 0.2 + 0.9 * LAYER_GAP
    assert radius.max() < 0.22
    torch.testing.assert_close(outfit.rest_vertices[outfit.garment_of_vertex == 1], outer.rest_vertices)
    assert not behind(placed.numpy(), inner.vertices.numpy(), inner.faces.numpy(), 0.05).any()
    assert torch.equal(outfit.vertices[outfit.garment_of_vertex == 0], inner.vertices)


def test_a_loose_outer_layer_is_left_alone():
    inner, outer = tube("skirt", 0.2, 0.4, 0.9), tube("shirt", 0.23, 0.7, 1.2)
    moved = cleared(outer.vertices.numpy(), outer.faces.numpy(), inner.vertices.numpy(), inner.faces.numpy())
    np.testing.assert_array_equal(moved, outer.vertices.numpy())


def test_an_outfit_returns_from_disk(tmp_path):
    outfit = merged("both", [tube("skirt", 0.2, 0.4, 0.9), tube("shirt", 0.25, 0.7, 1.2)])
    outfit.save(tmp_path / "o.npz")
    read = Outfit.load(tmp_path / "o.npz")
    for name in ("vertices", "rest_vertices", "faces", "garment_of_vertex"):
        assert torch.equal(getattr(read, name), getattr(outfit, name))
    assert (read.name, read.garments) == ("both", ("skirt", "shirt"))
    np.savez(tmp_path / "x.npz", a=np.zeros(2))
    with pytest.raises(ValueError, match="is not an outfit: it lacks"):
        Outfit.load(tmp_path / "x.npz")


def test_the_list_is_what_the_issue_asks_for():
    """Ten outfits or more, two of them unseen, every layer a garment that can be cut."""
    assert sum(not ensemble.held_out for ensemble in ENSEMBLES) >= 10
    assert sum(ensemble.held_out for ensemble in ENSEMBLES) == 2
    assert {layer for ensemble in ENSEMBLES for layer in ensemble.layers} <= set(OUTFITS)
    assert len({ensemble.name for ensemble in ENSEMBLES}) == len(ENSEMBLES)
