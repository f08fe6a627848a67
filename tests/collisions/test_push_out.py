"""The post-process of Fig. 7 on a plane and on a body."""

import torch

from workbench.collisions.push_out import EPSILON, bulge, push_out
from workbench.geometry.mesh import vertex_normals


def grid(count: int, height: float):
    axis = torch.linspace(-0.5, 0.5, count)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    vertices = torch.stack([x.flatten(), y.flatten(), torch.full((count * count,), height)], -1)
    i = torch.arange(count - 1)
    corner = (i[:, None] * count + i).flatten()
    lower = torch.stack([corner, corner + count, corner + 1], -1)
    upper = torch.stack([corner + 1, corner + count, corner + count + 1], -1)
    return vertices, torch.cat([lower, upper])


def test_a_sheet_below_a_plane_ends_epsilon_above_it():
    plane, faces = grid(21, 0.0)
    if vertex_normals(plane, faces)[0, 2] < 0:
        faces = faces.flip(1)
    sheet = plane + torch.tensor([0.0, 0.0, -0.01])
    pushed = push_out(sheet, plane, faces)
    assert torch.allclose(pushed[:, 2], torch.full((len(pushed),), EPSILON), atol=1e-6)
    assert torch.equal(pushed, push_out(pushed, plane, faces))  # nothing left to push
    far = plane + torch.tensor([0.0, 0.0, 0.05])
    assert torch.equal(push_out(far, plane, faces), far)


def test_nothing_moved_is_no_bulge_and_a_rigid_push_loses_no_detail():
    sheet, faces = grid(15, 0.0)
    folded = sheet + torch.stack([0 * sheet[:, 0], 0 * sheet[:, 0], 0.02 * torch.sin(30 * sheet[:, 0])], -1)
    none = bulge(folded, folded, faces)
    assert not none.moved.any()
    assert none.detail_lost == none.shift == none.stretched == 0
    rigid = bulge(folded, folded + torch.tensor([0.0, 0.0, 0.01]), faces)
    assert rigid.moved.all()
    assert rigid.detail_lost < 1e-4
    assert rigid.stretched == 0
    assert abs(rigid.shift - 0.01) < 1e-7


def test_a_single_pushed_vertex_is_a_bulge():
    sheet, faces = grid(15, 0.0)
    folded = sheet + torch.stack([0 * sheet[:, 0], 0 * sheet[:, 0], 0.02 * torch.sin(30 * sheet[:, 0])], -1)
    poked = folded.clone()
    poked[112, 2] += 0.06
    harm = bulge(folded, poked, faces)
    assert int(harm.moved.sum()) == 1
    assert harm.detail_lost > 0.5
    assert harm.stretched > 0.3
