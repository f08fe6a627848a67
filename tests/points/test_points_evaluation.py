"""`workbench evaluate points` on scans that the model itself made: its error there is zero, the patches' is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from workbench import cli
from workbench.formats.mesh_sequence import Mesh
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.points import points_evaluation
from workbench.points.dressing import Dresser
from workbench.points.patches import PatchModel, PatchModelConfig
from workbench.points.points_evaluation import (
    PointsEvaluation,
    Rivals,
    models_beside,
    rows,
    step_seconds,
    table_rows,
    training_seconds,
)
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.trained_points import TrainedPatches, TrainedPoints
from workbench.points.training import PointTrainingConfig
from workbench.points.uv_position_map import posed_bodies

CONFIG = PointsEvaluation(frames=0, repeats=1, paper_step=False, fit_steps=2, fit_precision="float32")


def test_the_command_line_knows_it(capsys):
    assert cli.main(["evaluate", "points", "--help"]) == 0
    assert "--fit-steps" in capsys.readouterr().out


@pytest.fixture
def folder(body, small_model, trained_like, tmp_path, monkeypatch):
    """A model of dress and tshirt with its patches; test scans of the tshirt, and of a coat it never saw."""
    monkeypatch.setattr(points_evaluation, "PointModelConfig", lambda: small_model.config)
    monkeypatch.setattr(points_evaluation, "poisson_mesh", lambda points, normals: Mesh(points, np.zeros((1, 3), int)))
    model = trained_like(small_model)
    TrainedPoints(model, ("dress", "shorts", "tshirt")).save(tmp_path / "pop.safetensors", body)
    model = TrainedPoints.load(tmp_path / "pop.safetensors", body).model
    sizes = PatchModelConfig(PoseEncoderConfig(depth=3, width=4, features=6), ShapeDecoderConfig(24, 8), 16, 2)
    patches = trained_like(PatchModel(sizes, generator=torch.Generator().manual_seed(1)))
    TrainedPatches(patches, ("tshirt",)).save(tmp_path / "patches-tshirt.safetensors", body)
    generator = torch.Generator().manual_seed(2)
    rotations = axis_angle_to_matrix(0.1 * torch.randn(2, len(body.parents), 3, generator=generator))
    bodies = posed_bodies(body, rotations, body.mean_shape())
    (tmp_path / "test").mkdir()
    for outfit, number in (("tshirt", 2), ("coat", 1)):
        with torch.no_grad():
            cloud = Dresser(model, model.geometry(torch.tensor([number])), body)(bodies)
        frames = [ScanFrame(x, n) for x, n in zip(cloud.points, cloud.normals, strict=True)]
        ScanSequence.of(frames, outfit=outfit, motion="m", rotations=rotations, betas=body.mean_shape(), fps=30.0).save(
            tmp_path / "test" / f"{outfit}.npz"
        )
    return tmp_path


def test_a_model_has_no_error_on_what_it_made(folder):
    found = {row.metric: row for row in rows(replace(CONFIG, model=folder / "pop.safetensors", data=folder))}
    assert found["outfits never seen"].value == 1
    assert found["Tab. 2: Chamfer, 1e-4 m^2, POP, mean"].value < 1e-4
    assert found["Tab. 2: Chamfer, 1e-4 m^2, patches, mean"].value > 1e-2
    ratio = found["Tab. 2: Chamfer of POP / patches"]
    assert ratio.holds
    assert ratio.bound == "<= 0.85"
    # the coat is what the model makes of an outfit it knows: the fit begins there, and two steps stay there
    assert found["fit of coat: loss after"].value == pytest.approx(found["fit of coat: loss before"].value, rel=0.01)
    assert "unseen outfit: Chamfer below skinning of the scan" in found
    assert found["forward: points apart"].value < 0.5  # mm; what lies between decoded pixels, with random networks
    assert "training step: how much faster" not in found
    assert not any("1/4 of the data" in metric for metric in found)
    assert found["shipped"].bound == "<= 40"


def test_what_was_not_trained_is_left_out(folder, body):
    trained = TrainedPoints.load(folder / "pop.safetensors", body)
    scans = [ScanSequence.load(folder / "test" / "tshirt.npz")]
    alone = table_rows(trained, Rivals({}, {}, {}), scans, body)
    assert len(alone) == 9
    assert not any("patches" in row.metric for row in alone)
    (folder / "pop-every4.safetensors").write_bytes((folder / "pop.safetensors").read_bytes())
    rivals = models_beside(folder / "pop.safetensors", trained, body)
    assert (list(rivals.patches), list(rivals.fractions), list(rivals.alone)) == (["tshirt"], [4], [])
    found = {row.metric: row for row in table_rows(trained, rivals, scans, body)}
    assert found["Tab. 2: Chamfer of POP on 1/4 of the data / patches on all"].holds
    (folder / "pop-tshirt.safetensors").write_bytes((folder / "pop.safetensors").read_bytes())
    rivals = models_beside(folder / "pop.safetensors", trained, body)
    found = {row.metric: row for row in table_rows(trained, rivals, scans, body)}
    assert found["Tab. 2: normals of POP of all outfits / of one each"].value == pytest.approx(1, rel=1e-3)


def test_the_time_of_a_training_holds_that_of_what_it_began_with():
    first = {"curves": [{"step": 1, "CPU seconds": 2.0}, {"step": 2, "CPU seconds": 5.0}], "start": None}
    assert training_seconds(first) == 5
    assert training_seconds({"curves": [{"step": 1, "CPU seconds": 1.5}], "start": first}) == 6.5
    assert training_seconds({}) == 0


def test_a_step_is_timed(folder, body, small_model):
    scans = [ScanSequence.load(folder / "test" / "tshirt.npz")]
    few = PointTrainingConfig(batch=1, queries=100, scan_points=200, query_size=32)
    assert 0 < step_seconds(small_model, scans, body, few, 1) < 10
