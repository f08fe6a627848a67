"""`workbench train points`: which scans it learns from, one model or one an outfit, resumed runs, refusals."""

from dataclasses import replace

import pytest
import torch

from workbench.learning.fit import FitConfig
from workbench.learning.scalar_log import read_curves
from workbench.points import training_run
from workbench.points.clothed_points import PointModel, PointModelConfig
from workbench.points.patches import PatchModelConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.scans import ScanFrame, ScanSequence, load_scans
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.trained_points import TrainedPatches, TrainedPoints
from workbench.points.training import PointTrainingConfig
from workbench.points.training_run import TrainPointsConfig, begin_with, chosen, run, training_folder
from workbench.points.uv_position_map import posed_bodies

TRAINING = PointTrainingConfig(
    fit=FitConfig(steps=4, warmup=1, checkpoint_every=2),
    batch=2,
    queries=300,
    scan_points=500,
    calibration=1,
    precision="float32",
    query_size=32,
)


@pytest.fixture(scope="module")
def data(body, tmp_path_factory):
    """Two outfits, two frames each; and one of a test motion."""
    folder = tmp_path_factory.mktemp("scans")
    rotations = body.rest_rotations().repeat(2, 1, 1, 1)
    points = posed_bodies(body, rotations, body.mean_shape()).vertices[:, ::5]
    frames = [ScanFrame(p, torch.nn.functional.normalize(p, dim=-1)) for p in points]
    for part, outfit, motion in (("train", "dress", "walk"), ("train", "tshirt", "walk"), ("test", "dress", "jump")):
        (folder / part).mkdir(exist_ok=True)
        made = ScanSequence.of(
            frames, outfit=outfit, motion=motion, rotations=rotations, betas=body.mean_shape(), fps=30.0
        )
        made.save(folder / part / f"{outfit}_{motion}.npz")
    return folder


@pytest.fixture
def small(small_model, monkeypatch):
    monkeypatch.setattr(training_run, "TWO_CORES", small_model.config)
    patches = PatchModelConfig(PoseEncoderConfig(depth=3, width=4, features=6), ShapeDecoderConfig(24, 8), 16, 2)
    monkeypatch.setattr(training_run, "TWO_CORES_PATCHES", patches)


def test_test_motions_are_never_learned_from(data):
    assert training_folder(data) == data / "train"
    assert training_folder(data / "test") == data / "test"


def test_outfits_and_frames_are_chosen(data):
    scans = load_scans(data / "train")
    assert [scan.outfit for scan in chosen(scans, TrainPointsConfig(outfits="tshirt"))] == ["tshirt"]
    assert [scan.outfit for scan in chosen(scans, TrainPointsConfig(hold_out="tshirt"))] == ["dress"]
    assert [len(scan) for scan in chosen(scans, TrainPointsConfig(every=2))] == [1, 1]
    with pytest.raises(ValueError, match="no scans of cape; there are dress, tshirt"):
        chosen(scans, TrainPointsConfig(hold_out="cape"))
    with pytest.raises(ValueError, match="all are held out"):
        chosen(scans, TrainPointsConfig(hold_out="dress,tshirt"))


def test_one_model_of_all_outfits(data, small, tmp_path, body):
    """It holds both outfits and its story; a second run has nothing left to do and writes the same file."""
    config = TrainPointsConfig(data=data, out=tmp_path, training=TRAINING)
    (path,) = run(config)
    trained = TrainedPoints.load(path, body)
    assert path.name == "pop.safetensors"
    assert trained.outfits == ("dress", "tshirt")
    assert [entry["step"] for entry in trained.story["curves"]] == [2, 4]
    assert trained.story["motions"] == ["walk"]
    once = path.read_bytes()
    story = read_curves(tmp_path / "work" / "pop" / "curves.jsonl")
    run(config)
    assert read_curves(tmp_path / "work" / "pop" / "curves.jsonl") == story
    assert TrainedPoints.load(path, body).model.state_dict().keys() == trained.model.state_dict().keys()
    for name, tensor in trained.model.state_dict().items():
        assert torch.equal(TrainedPoints.load(path, body).model.state_dict()[name], tensor)
    assert len(path.read_bytes()) == pytest.approx(len(once), abs=64)
    with pytest.raises(ValueError, match="belongs to another run"):
        run(replace(config, training=replace(TRAINING, fit=replace(TRAINING.fit, steps=6))))


def test_a_model_to_begin_with(data, small, tmp_path, body):
    """Of one outfit: its G is kept, the new outfit begins at the mean; other sizes are refused."""
    (first,) = run(TrainPointsConfig(data=data, out=tmp_path / "a", outfits="tshirt", training=TRAINING))
    trained = TrainedPoints.load(first, body)
    model = PointModel(2, trained.model.config, generator=torch.Generator().manual_seed(9))
    begin_with(trained, model, ("dress", "tshirt"))
    assert torch.equal(model.geometry.stored[0], trained.model.geometry.stored[0])
    assert torch.equal(model.geometry.stored[1], trained.model.geometry.stored[0])
    assert torch.equal(model.decoder.to_normal.weight, trained.model.decoder.to_normal.weight)
    (second,) = run(TrainPointsConfig(data=data, out=tmp_path / "b", start=first, training=TRAINING))
    assert TrainedPoints.load(second, body).story["start"]["motions"] == ["walk"]
    with pytest.raises(ValueError, match="the model to begin with has sizes"):
        begin_with(trained, PointModel(1, PointModelConfig(), generator=torch.Generator()), ("tshirt",))


def test_one_model_an_outfit(data, small, tmp_path, body):
    paths = run(TrainPointsConfig(data=data, out=tmp_path, per_outfit=True, training=TRAINING))
    assert [path.name for path in paths] == ["pop-dress.safetensors", "pop-tshirt.safetensors"]
    assert [TrainedPoints.load(path, body).outfits for path in paths] == [("dress",), ("tshirt",)]


def test_patches_have_a_model_an_outfit(data, small, tmp_path, body):
    paths = run(TrainPointsConfig(data=data, out=tmp_path, method="patches", training=TRAINING))
    assert [path.name for path in paths] == ["patches-dress.safetensors", "patches-tshirt.safetensors"]
    assert TrainedPatches.load(paths[0], body).outfits == ("dress",)
