"""The corrective's ONNX graph gives what torch gives."""

import numpy as np
import onnxruntime
import pytest
import torch

from workbench.collisions.corrective_onnx import corrective_graph
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.limb_sight import LimbSight
from workbench.collisions.posed_corrective import REACH, PosedCorrective
from workbench.geometry.patches import Patches
from workbench.geometry.rotations import axis_angle_to_matrix


@pytest.mark.parametrize("size", [0.1, 100.0])  # 100: far beyond its reach
def test_a_frame_in_onnxruntime_is_one_in_torch(body, size):
    chance = torch.Generator().manual_seed(5)
    points = torch.tensor([0.0, 0.0, 1.2]) + 0.2 * torch.randn(200, 3, generator=chance)
    patches = Patches.of(points, 9)
    sight = LimbSight.of(body, GridFields.default(), patches.centres(points))
    basis = torch.randn(5, 3 * patches.vertices.numel(), generator=chance)
    corrective = PosedCorrective("tshirt", patches, sight, basis, 24, chance)
    with torch.no_grad():
        for parameter in corrective.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=chance)
        corrective.last *= size
    session = onnxruntime.InferenceSession(corrective_graph(corrective).SerializeToString())
    for _ in range(3):
        pose = axis_angle_to_matrix(0.5 * torch.randn(len(body.parents), 3, generator=chance))
        betas, latent = (torch.randn(1, count, generator=chance) for count in (body.shape_count, 25))
        given = {"rotations": pose.numpy(), "betas": betas.numpy(), "latent": latent.numpy()}
        with torch.no_grad():
            wanted = corrective(pose, betas[0], latent[0])
        np.testing.assert_allclose(np.asarray(session.run(None, given)[0]), wanted, atol=2e-6)
        if size > 1:
            assert float(wanted.square().sum(-1).mean().sqrt()) == pytest.approx(REACH, rel=1e-4)
