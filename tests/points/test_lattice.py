"""Every second pixel and what lies between: exact on what is bilinear, and doubt where it is not."""

import torch

from workbench.points.dressing import Dresser
from workbench.points.lattice import Lattice
from workbench.points.shape_decoder import CanonicalClothes
from workbench.points.uv_position_map import atlas_of, posed_bodies

SIZE = 64


def test_what_is_bilinear_is_exact(body):
    """a + b u + c v + d u v within each cell, corners beyond the charts included."""
    atlas = atlas_of(body, SIZE)
    lattice = Lattice.of(atlas)

    def plane(u):
        x, y = u.unbind(1)
        return torch.stack([1 + x - 2 * y, 3 * y, x - y], 1)

    torch.testing.assert_close(lattice.between(plane(lattice.u)), plane(atlas.queries.u), atol=1e-5, rtol=0)
    assert (
        lattice.doubtful(plane(lattice.u), 1e-5).float().mean() < 0.02
    )  # rows of two corners, of which nothing is known
    both = lattice.clothes(CanonicalClothes(plane(lattice.u), -plane(lattice.u)))
    torch.testing.assert_close(both.normal, -both.displacement)


def test_there_are_few_corners_and_each_is_used(body):
    atlas = atlas_of(body, 256)
    lattice = Lattice.of(atlas)
    assert len(lattice.u) < 0.32 * len(atlas.pixel)
    assert torch.equal(lattice.corners.unique(), torch.arange(len(lattice.u)))
    torch.testing.assert_close(lattice.weights.sum(1), torch.ones(len(atlas.pixel)))


def test_a_parabola_is_off_by_what_its_bend_says(body):
    """Away from the charts' edges, the doubt is the error."""
    atlas = atlas_of(body, SIZE)
    lattice = Lattice.of(atlas)
    inner = ((lattice.across >= 0) & (lattice.down >= 0)).all(1)[lattice.corners].all(1)

    def bowl(u):
        return u.square().sum(1, keepdim=True) * torch.tensor([1.0, 0, 0])

    error = (lattice.between(bowl(lattice.u)) - bowl(atlas.queries.u)).norm(dim=1)
    worst = float(error[inner].max())
    assert worst > 1e-4
    assert lattice.doubtful(bowl(lattice.u), 0.99 * worst)[inner].any()
    assert not lattice.doubtful(bowl(lattice.u), 1.01 * worst)[inner].any()


def test_dressing_keeps_its_tolerance(body, small_model, trained_like):
    """Against every pixel decoded; a tolerance of almost nothing decodes them all."""
    model = trained_like(small_model)
    bodies = posed_bodies(body, body.rest_rotations()[None], body.mean_shape())
    with torch.no_grad():
        geometry = model.geometry(torch.tensor([0]))
    exact = Dresser(model, geometry, body, tolerance=0.0)(bodies)
    near = Dresser(model, geometry, body, tolerance=1e-4)(bodies)
    assert 0 < (near.points - exact.points).norm(dim=-1).max() < 2e-4
    closer = Dresser(model, geometry, body, tolerance=1e-12)(bodies)
    assert (closer.points - exact.points).norm(dim=-1).mean() < 1e-6
