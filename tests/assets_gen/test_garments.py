"""Cuts: legs and skirts are extruded to their hem, one orientation; a belt draws in the waistband only."""

import numpy as np
import pytest
import torch

from assets_gen.garments import BELT, OUTFITS, Landmarks, LowerOutfit, _belted, _extrude, _lower_pattern
from workbench.geometry.mesh import QuadMesh, boundary_loops, inspect_topology, triangulate


def trouser_stump(sections=16):
    """Quads of two short upright tubes, a left and a right leg (the waist is left out)."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    ring = 0.1 * np.stack([np.cos(angle), np.sin(angle)], 1)
    vertices, quads = [], []
    i, j = np.arange(sections), np.roll(np.arange(sections), -1)
    for x in (0.11, -0.11):
        start = sum(map(len, vertices))
        for z in (0.74, 0.70):
            vertices.append(np.column_stack([ring + [x, 0], np.full(sections, z)]))
        quads.append(start + np.stack([sections + i, sections + j, j, i], 1))
    return np.concatenate(vertices), np.concatenate(quads)


@pytest.fixture(scope="module")
def at(body):
    return Landmarks.of(body)


def test_legs_follow_the_bones_down_to_the_hem(at):
    vertices, quads = trouser_stump()
    outfit = LowerOutfit("t", top=0.1, cut=-0.2, hem=-0.7, flare=-0.3, legs=2)
    grown, all_quads = _extrude(vertices, quads, outfit, 2, at)
    hem = grown[np.abs(grown[:, 2] - (at.hip[2] - 0.7)) < 1e-9]
    assert len(hem) == 2 * 16
    for side in (1, -1):
        leg = hem[np.sign(hem[:, 0]) == side]
        middle = leg[:, :2].mean(0)
        aside = (at.leg_axis(np.array([at.hip[2] - 0.7])) - at.leg_axis(np.array([0.70])))[0]
        np.testing.assert_allclose(middle, [side * (0.11 + aside[0]), aside[1]], atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(leg[:, :2] - middle, axis=1), 0.07, atol=1e-6)  # narrowed by 30 %
    topology = inspect_topology(triangulate(QuadMesh(torch.from_numpy(grown), torch.from_numpy(all_quads))), len(grown))
    assert topology.oriented
    assert topology.manifold
    assert topology.parts == 2


def test_a_skirt_widens_by_its_flare(at):
    vertices, quads = trouser_stump()
    one = vertices[: len(vertices) // 2], quads[: len(quads) // 2]
    outfit = LowerOutfit("s", top=0.1, cut=-0.2, hem=-0.5, flare=0.5, legs=1)
    grown, all_quads = _extrude(*one, outfit, 1, at)
    hem = grown[np.abs(grown[:, 2] - (at.hip[2] - 0.5)) < 1e-9]
    np.testing.assert_allclose(np.linalg.norm(hem[:, :2] - [0.11, 0], axis=1), 0.15, atol=1e-6)
    triangles = np.concatenate([all_quads[:, [0, 1, 2]], all_quads[:, [0, 2, 3]]])
    assert len(boundary_loops(torch.from_numpy(triangles))) == 2


def test_a_belt_draws_in_the_waistband_and_nothing_else(at):
    outfit = OUTFITS["trousers"]
    assert isinstance(outfit, LowerOutfit)
    top = at.hip[2] + outfit.top
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    waist = np.column_stack([0.15 * np.cos(angle), 0.1 * np.sin(angle), np.full(40, top)])
    below = waist - [0, 0, BELT + 0.01]
    drawn = _belted(np.concatenate([waist, below]), outfit, at)
    np.testing.assert_array_equal(drawn[40:], below)
    np.testing.assert_allclose(drawn[:40, :2], (1 - outfit.belt) * waist[:, :2], atol=1e-9)
    np.testing.assert_array_equal(drawn[:40, 2], waist[:, 2])


def test_a_lower_pattern_leaves_the_hands_out_and_straightens_its_borders(at):
    outfit = OUTFITS["shorts"]
    assert isinstance(outfit, LowerOutfit)
    pattern = _lower_pattern(outfit, at)
    hip, hand = at.hip + [0.05, 0, 0], np.array([0.55, 0, at.hip[2]])
    assert pattern.keep(np.stack([hip, hand])).tolist() == [True, False]
    borders = np.array([[0.1, 0, at.hip[2] + outfit.top - 0.02], [0.1, 0, at.hip[2] + outfit.hem + 0.03]])
    np.testing.assert_allclose(pattern.onto_cut(borders)[:, 2] - at.hip[2], [outfit.top, outfit.hem])
    assert (np.diff(pattern.gap(np.stack([at.hip + [0, 0, outfit.top], at.hip, at.knee]))) >= 0).all()
