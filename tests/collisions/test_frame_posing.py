"""One frame by table and kernel: what the garment model gives, whatever the shape, the pose and the point."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.collisions.diffused_body import GridFields
from workbench.collisions.frame_posing import ModelPoser, TablePoser, frame_poser, in_chunks
from workbench.collisions.garment_model import GarmentModel
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix


@pytest.fixture(scope="module")
def model(body) -> GarmentModel:
    return GarmentModel(body, GridFields.default())


def random_pose(body, seed: int, size: float = 0.6):
    chance = torch.Generator().manual_seed(seed)
    turns = size * torch.randn(len(body.parents), 3, generator=chance)
    return axis_angle_to_matrix(turns), torch.randn(3, generator=chance), torch.randn(10, generator=chance)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_two_ways_to_pose_agree(body, model, seed):
    rotations, translation, betas = random_pose(body, seed)
    X = Garment.load("tshirt").vertices
    X = X + 0.01 * torch.randn(X.shape, generator=torch.Generator().manual_seed(seed))
    fast = TablePoser(body, model.fields, betas, len(X))  # pyright: ignore[reportArgumentType]
    slow = ModelPoser(model, betas)
    found, wanted = fast(X, rotations, translation), slow(X, rotations, translation)
    assert float((found - wanted).norm(dim=-1).max()) < 1e-5  # metres


def test_they_agree_anywhere_in_the_box_and_outside_of_it(body, model):
    rotations, translation, betas = random_pose(body, 3)
    X = 4 * torch.rand(3000, 3, generator=torch.Generator().manual_seed(3)) - 2
    fast, slow = frame_poser(model, betas, len(X)), ModelPoser(model, betas)
    assert isinstance(fast, TablePoser)
    torch.testing.assert_close(fast(X, rotations, translation), slow(X, rotations, translation), atol=1e-5, rtol=1e-5)


def test_a_frame_does_not_depend_on_those_before_it(body, model):
    _, _, betas = random_pose(body, 5)
    X = Garment.load("tshirt").vertices
    used = TablePoser(body, model.fields, betas, len(X))
    for seed in range(5):  # the garment moves through space: rows are added on the way
        rotations, translation, _ = random_pose(body, seed)
        moved = X + 0.1 * torch.randn(3, generator=torch.Generator().manual_seed(seed))
        fresh = TablePoser(body, model.fields, betas, len(X))
        assert torch.equal(used(moved, rotations, translation), fresh(moved, rotations, translation))


def test_a_result_outlives_the_next_frame(body, model):
    rotations, translation, betas = random_pose(body, 6)
    pose = TablePoser(body, model.fields, betas, 50)
    X = Garment.load("tshirt").vertices[:50]
    first = pose(X, rotations, translation)
    kept = first.clone()
    pose(X + 0.1, rotations, translation)
    assert torch.equal(first, kept)


def test_it_never_holds_more_rows_than_the_table(body, model):
    _, _, betas = random_pose(body, 7)
    chance = torch.Generator().manual_seed(7)
    pose = TablePoser(body, model.fields, betas, 2000)
    for _ in range(5):
        pose(3 * torch.rand(2000, 3, generator=chance) - 1, body.rest_rotations(), torch.zeros(3))
    nodes = pose.nodes
    assert nodes.row_count == len(np.unique(nodes.corners[: nodes.leaf_count])) <= len(model.fields.grid.values)
    numbered = -2 - nodes.child[nodes.child < -1]
    assert sorted(numbered) == list(range(nodes.leaf_count))


def test_a_cell_between_known_ones_needs_no_new_rows(body, model):
    _, _, betas = random_pose(body, 10)
    nodes = TablePoser(body, model.fields, betas, 1).nodes
    cell = model.fields.grid.locate(Garment.load("tshirt").vertices[:1]).nodes[0].numpy()
    corners = model.fields.grid.corner.numpy()
    last = int(np.flatnonzero((corners == cell).all(1) & (nodes.child == -1))[0])
    around = np.flatnonzero(np.isin(corners, cell).any(1) & (nodes.child == -1))
    nodes.add(around[around != last])
    rows = nodes.row_count
    nodes.add(np.array([last]))
    assert nodes.row_count == rows


def test_the_integers_reach_as_far_as_the_table_does(body, model):
    betas = torch.linspace(-5, 5, 10)
    nodes = TablePoser(body, model.fields, betas, 1).nodes
    every = model.fields.layout.split(model.fields.grid.values)
    pose = every.pose_directions.abs().amax((0, 2)).numpy()
    shape = torch.einsum("k,nki->ni", betas, every.shape_directions).abs().amax()
    assert (32767 * nodes.step >= np.append(float(shape), pose)).all()


def test_other_fields_go_through_the_model(body, analytic_fields):
    rotations, translation, betas = random_pose(body, 8)
    model = GarmentModel(body, analytic_fields(body))
    X = Garment.load("tshirt").vertices[:20]
    pose = frame_poser(model, betas, 20)
    assert isinstance(pose, ModelPoser)
    assert torch.equal(pose(X, rotations, translation), model.posed(X, model.state(rotations, betas, translation)))


def test_chunks_keep_every_triple_whole():
    triples = np.arange(1, 25, dtype=np.float32)[None]  # 8 of them, 5 a chunk
    chunks = in_chunks(triples, 2).reshape(2, 16)
    np.testing.assert_array_equal(chunks[0, :15], triples[0, :15])
    np.testing.assert_array_equal(chunks[1, :9], triples[0, 15:])
    assert chunks[0, 15] == 0
    assert not chunks[1, 9:].any()


def test_unusable_points_are_refused(body, model):
    rotations, translation, betas = random_pose(body, 9)
    pose = TablePoser(body, model.fields, betas, 4)
    with pytest.raises(ValueError, match="made for 4 points, but got 5"):
        pose(torch.zeros(5, 3), rotations, translation)
    with pytest.raises(ValueError, match="1 of the garment's canonical vertices are NaN"):
        pose(torch.tensor([[0, 0, torch.nan], [0, 0, 0], [0, 0, 0], [0, 0, 0]]), rotations, translation)


def test_a_row_holds_what_the_table_holds(body, model):
    _, _, betas = random_pose(body, 11)
    nodes = TablePoser(body, model.fields, betas, 1).nodes
    chance = np.random.default_rng(11)
    leaves = np.flatnonzero(nodes.child == -1)
    for count in (300, 1, 40):  # rows are added to rows
        nodes.add(chance.choice(leaves[nodes.child[leaves] == -1], count, replace=False))
    rows = nodes.place[nodes.place >= 0]
    wanted = model.fields.layout.split(model.fields.grid.values[np.flatnonzero(nodes.place >= 0)]).weights.numpy()
    found = np.zeros_like(wanted)
    for place, row in enumerate(rows):
        of_row = slice(nodes.begins[row], nodes.begins[row + 1])
        np.add.at(found[place], nodes.carriers[of_row], nodes.weights[of_row])
    np.testing.assert_array_equal(found, wanted)
    assert sorted(rows) == list(range(nodes.row_count))
