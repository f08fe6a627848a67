"""`workbench evaluate projection`: what its rows are made of."""

import numpy as np
import torch

from workbench.body.model import Body
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.projection_evaluation import inside_canonical
from workbench.geometry.sampling import sample_box, sample_shell
from workbench.geometry.winding import InsideTest


def test_the_table_of_distances_spares_work_and_changes_no_verdict(rng):
    body = Body.default()
    vertices, faces = body.template.numpy(), body.faces.numpy()
    near = sample_shell(vertices, faces, 3000, -0.02, 0.02, rng)
    far = sample_box(vertices.min(0), vertices.max(0), 3000, rng)
    points = np.concatenate([near, far])
    test = InsideTest(vertices, faces)
    found = inside_canonical(torch.from_numpy(points).reshape(2, 3000, 3), test, GridSDF.default())
    assert 0.1 < found.float().mean() < 0.9
    np.testing.assert_array_equal(found.flatten().numpy(), test(points))
