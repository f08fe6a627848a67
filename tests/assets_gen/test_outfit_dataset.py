"""The plan of the outfits' scans: splits by motion, outfits first, what ships is a small part."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from assets_gen.dataset import DatasetConfig, chosen
from assets_gen.dataset import plan as dataset_plan
from assets_gen.motions import FAMILIES
from assets_gen.outfit_dataset import (
    HELD_OUT,
    MOST_INSIDE,
    SCANNED_ALONE,
    SHIPPED_TRAIN,
    OutfitsConfig,
    compact,
    plan,
    run,
    scannable,
    shipped,
    split_of,
)
from assets_gen.outfits import ENSEMBLES
from workbench.body.model import Body
from workbench.collisions.sequences import SHIPPED, SimulatedSequence
from workbench.points.scans import ScanFrame, ScanSequence


@pytest.fixture(scope="module")
def rounds():
    return plan(OutfitsConfig(), Body.default())


def family(motion):
    return FAMILIES[motion.rpartition("_")[0]]


def scans(outfit, motion, rng, frames=8, points=25_000):
    normals = np.tile(np.array([0, 0, 1], np.float32), (points, 1))
    return ScanSequence.of(
        [
            ScanFrame(torch.from_numpy(rng.normal(size=(points, 3)).astype(np.float32)), torch.from_numpy(normals))
            for _ in range(frames)
        ],
        outfit=outfit,
        motion=motion,
        rotations=torch.eye(3).expand(frames, 2, 3, 3),
        betas=torch.zeros(3),
        fps=30.0,
    )


def test_every_round_has_every_combined_outfit(rounds):
    names = {ensemble.name for ensemble in ENSEMBLES} - {"tshirt", "dress"}
    assert len(names) == 10
    for round_ in rounds:
        assert {one.ensemble.name for one in round_} == names


def test_each_outfit_has_enough_frames_on_several_shapes(rounds):
    assert len(rounds) * OutfitsConfig().frames >= 250
    for k in range(len(rounds[0])):
        own = [round_[k] for round_ in rounds]
        assert len({one.motion for one in own}) == len(own)
        assert len({tuple(one.betas.tolist()) for one in own}) == len(own)


def test_the_split_is_by_motion_and_by_shape(rounds):
    seen = [one for r, round_ in enumerate(rounds) for one in round_ if r != 1]
    unseen = rounds[1]
    assert {family(one.motion).split for one in seen} == {"train"}
    assert {family(one.motion).split for one in unseen} == {"test"}
    shapes = {tuple(one.betas.tolist()) for one in seen}
    assert not shapes & {tuple(one.betas.tolist()) for one in unseen}


def test_no_scan_of_a_held_out_outfit_is_for_training(rng):
    assert len(HELD_OUT) == 2
    for outfit in HELD_OUT:
        assert split_of(scans(outfit, "walk_00", rng, 1, 10)) == "test"
    assert split_of(scans("tshirt", "walk_00", rng, 1, 10)) == "train"
    assert split_of(scans("tshirt", "test_wave_00", rng, 1, 10)) == "test"


def test_what_ships_is_part_of_what_was_scanned(rng):
    whole = scans("tshirt", "walk_00", rng)
    small = compact(whole)
    step = len(whole) // SHIPPED_TRAIN
    assert len(small) == SHIPPED_TRAIN and small.ticks.shape[1] == 10_000
    last = SHIPPED_TRAIN - 1
    assert torch.equal(small.frame(last).points, whole.frame(last * step).points[:10_000])
    assert compact(scans(min(HELD_OUT), "walk_00", rng)).ticks.shape[1] == 20_000


def test_bad_requests_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"no outfit is called cape; there are longsleeve, .*assets_gen dataset"):
        run(OutfitsConfig(out=tmp_path, only=("cape",)))
    with pytest.raises(ValueError, match="no sequences of tshirt or dress in "):
        run(OutfitsConfig(out=tmp_path, rounds=0, sequences=tmp_path))


def test_a_pinched_vertex_is_forgiven_a_torn_garment_is_not():
    sequence = SimulatedSequence.load(next(SHIPPED.glob("tshirt_*.npz")))
    count = len(sequence)
    record = OutfitsConfig().record

    def judged(inside=0, usual=1.2, rare=1.4):
        facts = {"vertices_inside": [inside] * count, "usual_stretch": [usual] * count, "rare_stretch": [rare] * count}
        again = scannable(replace(sequence, made_by=json.dumps(facts)), record)
        assert again.valid.all() == again.valid.any()
        return bool(again.valid.any())

    assert judged() and judged(inside=MOST_INSIDE)
    assert not judged(inside=MOST_INSIDE + 1)
    assert not judged(usual=record.usual_stretch + 0.01)
    assert not judged(rare=record.rare_stretch + 0.01)


def test_of_an_outfit_that_is_held_out_two_sequences_ship():
    rng = np.random.default_rng(0)
    held_out, seen = min(HELD_OUT), "tshirt-skirt"
    every = [scans(outfit, f"walk_{k:02d}", rng, 2, 50) for k in range(4) for outfit in (held_out, seen)]
    kept = [(scan.outfit, scan.motion) for scan in shipped(every)]
    assert kept == [(s.outfit, s.motion) for s in every if s.outfit == seen or s.motion in ("walk_00", "walk_01")]


def test_single_garments_can_be_simulated_from_the_command_line():
    body = Body.default()
    for garment, rounds in (("tshirt", 12), ("dress", 5)):
        planned = dataset_plan(DatasetConfig(garment=garment, per_family=rounds), body)
        kept = chosen(planned, SCANNED_ALONE[garment])
        assert {one.motion for one in kept} == set(SCANNED_ALONE[garment])
    assert chosen(planned, ()) == planned
    with pytest.raises(ValueError, match="the plan has no fly_00"):
        chosen(planned, ("fly_00",))


def test_single_garments_are_scanned_on_one_motion_a_family():
    for motions in SCANNED_ALONE.values():
        families = [motion.rpartition("_")[0] for motion in motions]
        assert len(set(families)) == len(families)
        assert {FAMILIES[name].split for name in families} == {"train", "test"}
