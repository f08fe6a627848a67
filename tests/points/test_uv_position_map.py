"""Position map, queries and local transforms: exact on the mesh, continuous, blind to where the body stands."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.body.skinning import linear_blend
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.points.uv_position_map import (
    Atlas,
    atlas_fingerprint,
    atlas_of,
    builds,
    heading,
    pelvis_frame,
    posed_bodies,
    posed_queries,
    scattered_queries,
    without_heading,
)


def poses(body, count=2, seed=0, spread=0.25):
    generator = torch.Generator().manual_seed(seed)
    return axis_angle_to_matrix(spread * torch.randn(count, len(body.parents), 3, generator=generator))


@pytest.fixture(scope="module")
def atlas(body) -> Atlas:
    return atlas_of(body, 64)


def test_pixels_show_points_of_the_posed_surface(body, atlas):
    rotations, betas = poses(body, 1), torch.full((1, body.shape_count), 0.5)
    bodies = posed_bodies(body, rotations, betas)
    points = posed_queries(atlas.queries, bodies).points[0]
    found = ClosestPoint(bodies.vertices[0].numpy(), body.faces.numpy()).query(points.numpy())
    assert found.distance.max() < 1e-5


def test_the_map_holds_at_each_pixel_the_point_there(body, atlas):
    bodies = posed_bodies(body, poses(body), body.mean_shape())
    image = atlas.map_of(bodies.neutral)
    assert image.shape == (2, 3, 64, 64)
    at_pixels = image.flatten(-2)[..., atlas.pixel].mT
    torch.testing.assert_close(at_pixels, atlas.queries.interpolate(bodies.neutral))
    empty = torch.ones(64 * 64, dtype=torch.bool)
    empty[atlas.pixel] = False
    assert (image.flatten(-2)[..., empty] == 0).all()


def test_u_of_a_pixel_is_its_centre_and_interpolates_the_charts(body, atlas):
    column, row = atlas.pixel % 64, atlas.pixel // 64
    torch.testing.assert_close(atlas.queries.u, (torch.stack([column, row], 1) + 0.5) / 64)
    # the same point by way of the mesh's own texture coordinates (wherever the vertex lies in one chart only)
    uv = torch.full((len(body.template), 2), torch.nan)
    uv[body.faces.reshape(-1)] = body.uv[body.uv_faces.reshape(-1)]
    seam = torch.zeros(len(body.template), dtype=torch.bool)
    differs = (uv[body.faces] - body.uv[body.uv_faces]).abs().amax((1, 2)) > 0
    seam[body.faces[differs].reshape(-1)] = True
    inner = ~seam[atlas.queries.corners].any(1)
    assert inner.float().mean() > 0.75
    torch.testing.assert_close(atlas.queries.interpolate(uv)[inner], atlas.queries.u[inner], atol=1e-5, rtol=0)


def test_a_refined_map_reads_between_the_pixels_of_a_coarse_one(body):
    """Bilinear reading of the 256 map at 128's pixel centres errs by curvature only: no half-pixel shift is left."""
    coarse, fine = atlas_of(body, 128), atlas_of(body, 256)
    vertices = body.template
    image, inside = fine.map_of(vertices), fine.map_of(torch.ones(len(vertices), 1))
    at = (2 * coarse.queries.u - 1)[None, None]
    read = torch.nn.functional.grid_sample(image[None], at, align_corners=False)[0, :, 0].T
    whole = torch.nn.functional.grid_sample(inside[None], at, align_corners=False)[0, 0, 0] > 0.999
    error = (read - coarse.queries.interpolate(vertices)).norm(dim=1)[whole]
    step = (image[:, :, 1:] - image[:, :, :-1]).norm(dim=0)[(inside[0, :, 1:] * inside[0, :, :-1]) > 0].median()
    assert error.median() < 0.05 * step  # half a pixel would be 0.5


def test_local_transforms_carry_rest_offsets_as_skinning_does(body, atlas):
    """T_i (q' - q) is what linear blending does to a small rest offset at a vertex."""
    rotations = poses(body, 1)
    bodies = posed_bodies(body, rotations, body.mean_shape())
    local = rotations.clone()
    local[:, 0] = without_heading(rotations[:, 0])
    transforms = body.pose(local, body.mean_shape()).transforms
    offset = torch.tensor([0.01, -0.02, 0.005])
    base = linear_blend(body.template, body.weights, transforms)
    moved = linear_blend(body.template + offset, body.weights, transforms)
    torch.testing.assert_close((bodies.transforms @ offset), moved - base, atol=1e-5, rtol=0)


def test_transforms_are_continuous_over_the_surface(body):
    """Between neighbouring pixels they change half as much on a map twice as fine (by vertex, jumps would stay)."""
    bodies = posed_bodies(body, poses(body, 1), body.mean_shape())

    def largest_change(size):
        atlas = atlas_of(body, size)
        transforms, rest = posed_queries(atlas.queries, bodies).transforms[0], atlas.queries.interpolate(body.template)
        left = torch.nonzero((atlas.pixel[1:] - atlas.pixel[:-1]) == 1)[:, 0]
        left = left[(rest[left + 1] - rest[left]).norm(dim=1) < 0.01]  # not across the gap between two charts
        return (transforms[left + 1] - transforms[left]).flatten(1).norm(dim=1).quantile(0.999)

    assert largest_change(1024) < 0.62 * largest_change(512)


def test_where_the_body_stands_and_looks_changes_nothing(body):
    rotations = poses(body, 1)
    turned = rotations.clone()
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 2.1]))
    turned[:, 0] = turn @ rotations[:, 0]
    betas = torch.full((1, body.shape_count), -0.4)
    one, two = posed_bodies(body, rotations, betas), posed_bodies(body, turned, betas)
    torch.testing.assert_close(one.vertices, two.vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(one.transforms, two.transforms, atol=1e-5, rtol=0)
    shift = torch.tensor([[1.0, -2.0, 0.3]])
    world = body.vertices(turned, betas, shift)
    frame = pelvis_frame(body, turned, betas, shift)
    torch.testing.assert_close(frame.to_local(world), two.vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(frame.to_world(two.vertices), world, atol=1e-5, rtol=0)


def test_what_is_seen_tells_pose_and_build_apart(body):
    """The neutral body knows no shape; the build knows no pose, and adds up to the own body at rest."""
    rotations, mean = poses(body, 2), body.mean_shape()
    betas = torch.linspace(-1, 1, body.shape_count)
    plain, own = posed_bodies(body, rotations, mean), posed_bodies(body, rotations, betas)
    torch.testing.assert_close(plain.neutral, own.neutral)
    torch.testing.assert_close(plain.neutral, plain.vertices, atol=1e-6, rtol=0)
    assert (own.vertices - plain.vertices).abs().max() > 0.01
    assert not plain.build.any()
    torch.testing.assert_close(own.build[0], own.build[1])
    rest = posed_bodies(body, body.rest_rotations()[None], betas)
    torch.testing.assert_close(rest.neutral + rest.build, rest.vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(builds(body, mean + 2 * (betas - mean)), 2 * own.build[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(own.seen[..., :3], own.neutral)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-1.2, 1.2), min_size=3, max_size=3), st.floats(-3, 3))
def test_heading_and_tilt(vector, turn):
    rotation = axis_angle_to_matrix(torch.tensor(vector, dtype=torch.float64))
    about_z = axis_angle_to_matrix(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
    torch.testing.assert_close(heading(rotation) @ without_heading(rotation), rotation)
    torch.testing.assert_close(heading(about_z), about_z)
    torch.testing.assert_close(without_heading(about_z @ rotation), without_heading(rotation), atol=1e-6, rtol=0)


def test_scattered_queries_lie_on_the_body_evenly(body, rng):
    queries = scattered_queries(body, 20_000, rng)
    points = queries.interpolate(body.template)
    found = ClosestPoint(body.template.numpy(), body.faces.numpy()).query(points.numpy())
    assert found.distance.max() < 1e-5
    assert (queries.u >= 0).all()
    assert (queries.u <= 1).all()
    upper = (points[:, 2] > body.joint_template[0, 2]).float().mean()
    corners = body.template[body.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    share = area[corners.mean(1)[:, 2] > body.joint_template[0, 2]].sum() / area.sum()
    assert float(upper) == pytest.approx(float(share), abs=0.015)


def test_bodies_without_or_with_bad_texture_are_refused(body, rng):
    bare = replace(body, uv=None, uv_faces=None)
    with pytest.raises(ValueError, match=r"has no texture coordinates.*give it arrays `uv`"):
        atlas_of(bare, 32)
    with pytest.raises(ValueError, match="has no texture coordinates"):
        scattered_queries(bare, 10, rng)
    folded = replace(body, uv=torch.stack([(body.uv[:, 0] - 0.5).abs(), body.uv[:, 1]], 1))
    with pytest.raises(ValueError, match=r"body 'default': the atlas overlaps itself"):
        atlas_of(folded, 32)


def test_the_fingerprint_knows_the_atlas(body):
    assert atlas_fingerprint(body) == atlas_fingerprint(body)
    assert atlas_fingerprint(body) != atlas_fingerprint(replace(body, uv=1 - body.uv))
    np.testing.assert_equal(len(atlas_fingerprint(body)), 16)
