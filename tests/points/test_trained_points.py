"""What is stored is what was trained; other files and other bodies are refused."""

from dataclasses import replace

import pytest
import torch

from workbench.points.patches import PatchModel, PatchModelConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.trained_points import TrainedPatches, TrainedPoints

OUTFITS = ("dress", "shorts", "tshirt")


def agree(one, other):
    for name, tensor in one.state_dict().items():
        torch.testing.assert_close(other.state_dict()[name], tensor, atol=1e-3, rtol=1e-3)


def test_what_is_stored_is_what_was_trained(small_model, trained_like, tmp_path, body):
    story = {"curves": [{"step": 1, "loss": 2.0}]}
    trained = TrainedPoints(trained_like(small_model), OUTFITS, story)
    trained.save(tmp_path / "m.safetensors", body)
    read = TrainedPoints.load(tmp_path / "m.safetensors", body)
    assert (read.outfits, read.story, read.model.config) == (OUTFITS, story, trained.model.config)
    assert not read.model.training
    agree(trained.model, read.model)
    assert read.number_of("shorts") == 1
    with pytest.raises(ValueError, match="knows no outfit 'cape'; it was trained on dress, shorts, tshirt"):
        read.number_of("cape")


def test_patches_too(trained_like, tmp_path, body):
    config = PatchModelConfig(PoseEncoderConfig(depth=3, width=4, features=6), ShapeDecoderConfig(24, 8), 16, 3)
    trained = TrainedPatches(trained_like(PatchModel(config, generator=torch.Generator().manual_seed(0))), ("dress",))
    trained.save(tmp_path / "p.safetensors", body)
    read = TrainedPatches.load(tmp_path / "p.safetensors", body)
    assert (read.outfits, read.model.config) == (("dress",), config)
    agree(trained.model, read.model)
    with pytest.raises(ValueError, match=r"is of kind 'patches-1', expected 'points-2'"):
        TrainedPoints.load(tmp_path / "p.safetensors", body)


def test_foreign_files_are_refused(small_model, tmp_path, body):
    path = tmp_path / "m.safetensors"
    TrainedPoints(small_model, OUTFITS).save(path, body)
    with pytest.raises(ValueError, match=r"was trained for another body .*train it for this body"):
        TrainedPoints.load(path, replace(body, template=body.template + 0.1))
    with pytest.raises(FileNotFoundError, match="there is no trained network"):
        TrainedPoints.load(tmp_path / "n.safetensors", body)
    path.write_bytes(b"{}")
    with pytest.raises(ValueError, match="is damaged"):
        TrainedPoints.load(path, body)
