"""A small points model and what it is asked about."""

import pytest
import torch

from workbench.points.clothed_points import PointModel, PointModelConfig
from workbench.points.geometry_features import GeometryFeaturesConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.shape_decoder import ShapeDecoderConfig

SMALL = PointModelConfig(
    encoder=PoseEncoderConfig(depth=4, width=4, features=6),
    geometry=GeometryFeaturesConfig(size=16, features=5),
    decoder=ShapeDecoderConfig(width=24, features=11),
    input_size=32,
)


@pytest.fixture
def small_model() -> PointModel:
    return PointModel(3, SMALL, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="session")
def trained_like():
    """In evaluation mode, with running statistics of something: a stand-in for what training leaves."""

    def changed(model):
        generator = torch.Generator().manual_seed(5)
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
                assert module.running_mean is not None
                assert module.running_var is not None
                module.running_mean += 0.3 * torch.randn(module.running_mean.shape, generator=generator)
                module.running_var *= 0.5 + torch.rand(module.running_var.shape, generator=generator)
            if isinstance(module, torch.nn.BatchNorm1d):
                module.weight.data *= 0.5 + torch.rand(module.weight.shape, generator=generator)
                module.bias.data += 0.3 * torch.randn(module.bias.shape, generator=generator)
        return model.eval()

    return changed
