"""The run time agrees with the model it speeds up, and stands where the motion says."""

import torch

from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.points.dressing import Dresser
from workbench.points.uv_position_map import atlas_of, posed_bodies, posed_queries


def motion_of(body, frames=2):
    generator = torch.Generator().manual_seed(0)
    rotations = axis_angle_to_matrix(0.2 * torch.randn(frames, len(body.parents), 3, generator=generator))
    return Motion(rotations, torch.randn(frames, 3, generator=generator), 30.0, body.skeleton, "test")


def test_it_agrees_with_the_plain_model(body, small_model, trained_like):
    """Every pixel decoded in float32 and masked afterwards, against valid pixels, folded: the same points."""
    model = trained_like(small_model)
    bodies = posed_bodies(body, motion_of(body).rotations, body.mean_shape())
    image = atlas_of(body, 32).map_of(bodies.neutral)
    with torch.no_grad():
        features = model.geometry(torch.tensor([1]))
        plain = model(image, torch.tensor([1, 1]), posed_queries(atlas_of(body, 48).queries, bodies))
    exact = Dresser(model, features, body, query_size=48, precision="float32", tolerance=0.0)(bodies)
    torch.testing.assert_close(exact.points, plain.points, atol=1e-6, rtol=0)
    torch.testing.assert_close(exact.normals, plain.normals, atol=1e-4, rtol=0)
    half = Dresser(model, features, body, query_size=48, precision="bfloat16")(bodies)
    moved = plain.displacement.norm(dim=-1).max()
    assert (half.points - plain.points).norm(dim=-1).max() < 0.05 * moved


def test_animation_stands_in_the_world(body, small_model, trained_like):
    """With the displacement's last layer at zero, the cloud is the moving body itself."""
    model = trained_like(small_model)
    torch.nn.init.zeros_(model.decoder.to_displacement.weight)
    torch.nn.init.zeros_(model.decoder.to_displacement.bias)
    motion, betas = motion_of(body), torch.full((body.shape_count,), 0.3)
    atlas = atlas_of(body, 32)
    with torch.no_grad():
        dresser = Dresser(model, model.geometry(torch.tensor([0])), body, queries=atlas.queries)
    surface = body.vertices(motion.rotations, betas, motion.translation)
    for frame, vertices in zip(dresser.animate(motion, betas), surface, strict=True):
        torch.testing.assert_close(frame.points, atlas.queries.interpolate(vertices), atol=1e-5, rtol=0)
        torch.testing.assert_close(frame.normals.norm(dim=-1), torch.ones(len(frame.normals)))
