"""What trains the networks that ship: which stages, on what."""

from dataclasses import replace

import pytest

from assets_gen.models import ModelsConfig, drawn_up_motions, run
from assets_gen.motions import FAMILIES
from workbench.motion import Motion


def test_an_unknown_stage_and_networks_that_are_missing_are_refused(tmp_path):
    config = ModelsConfig(out=tmp_path / "models", work=tmp_path / "work")
    with pytest.raises(ValueError, match="there is no stage decoder; there are subspace, regressor, corrective"):
        run(replace(config, stages=("corrective", "decoder")))
    with pytest.raises(ValueError, match="there is no stage to train"):
        run(replace(config, stages=()))
    with pytest.raises(ValueError, match="tshirt-subspace.safetensors is not there; train it as well"):
        run(replace(config, stages=("corrective",)))
    assert not (tmp_path / "models").exists()


def test_drawn_up_motions_are_the_same_every_time_and_of_every_family(tmp_path, body):
    config = ModelsConfig(work=tmp_path, drawn_up=1)
    folders = drawn_up_motions(config)
    for folder, kind in zip(folders, ("lifted", "curled"), strict=True):
        names = sorted(path.name for path in folder.glob("*.npz"))
        assert len(names) == sum(family.split == "train" for family in FAMILIES.values())
        assert all(name.endswith(f"_{kind}.npz") for name in names)
    first = Motion.load(folders[0] / sorted(path.name for path in folders[0].glob("*.npz"))[0])
    drawn_up_motions(config)
    assert Motion.load(folders[0] / f"{first.name}.npz").rotations.equal(first.rotations)
    assert len(first) == 60
