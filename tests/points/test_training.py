"""Training: it learns, resumes to the same model, and what it stores is what it trained."""

import pytest
import torch

from workbench.geometry.chamfer import match, plane_distance
from workbench.geometry.mesh import vertex_normals
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning.fit import FitConfig
from workbench.points.clothed_points import PointModel
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.training import (
    Jitter,
    PointTrainingConfig,
    ScanSet,
    looked_at,
    papers_training,
    thin,
    train_points,
    weights_at,
)
from workbench.points.uv_position_map import atlas_of, posed_bodies, posed_queries


class Killed(Exception):
    pass


def worn(body, outfit, gap, seed):
    """Scans of a body grown by `gap` metres along its normals: the simplest clothes."""
    generator = torch.Generator().manual_seed(seed)
    rotations = axis_angle_to_matrix(0.15 * torch.randn(3, len(body.parents), 3, generator=generator))
    bodies = posed_bodies(body, rotations, body.mean_shape())
    frames = []
    for vertices in bodies.vertices:
        normals = vertex_normals(vertices, body.faces)
        frames.append(ScanFrame(vertices + gap * normals, normals))
    return ScanSequence.of(frames, outfit=outfit, motion="m", rotations=rotations, betas=body.mean_shape(), fps=30.0)


@pytest.fixture(scope="module")
def scans(body):
    return ScanSet.of(body, [worn(body, "thick", 0.03, 0), worn(body, "thin", 0.005, 1)], input_size=32)


def config_of(**changes):
    return PointTrainingConfig(
        fit=FitConfig(steps=changes.pop("steps", 8), learning_rate=5e-3, warmup=2, clip_norm=100.0, checkpoint_every=4),
        **{
            "batch": 2,
            "queries": 400,
            "scan_points": 1500,
            "query_size": 64,
            "calibration": 2,
            "precision": "float32",
            **changes,
        },
    )


def fresh(small_model):
    return PointModel(2, small_model.config, generator=torch.Generator().manual_seed(3))


def test_it_learns_and_tells_outfits_apart(scans, small_model):
    """After a short run the cloud lies nearer to the thick outfit's surface than the bare body does, and the thick
    outfit stands further off the body than the thin one."""
    model = fresh(small_model)
    train_points(model, scans, config_of(steps=60))
    assert not model.training
    batch = scans.batch([0])
    posed = posed_queries(atlas_of(scans.body, 48).queries, batch.bodies)
    with torch.no_grad():
        thick, slim = (model(batch.position_map, torch.tensor([k]), posed) for k in (0, 1))

    def off_the_scan(points):
        scan = batch.scans[0]
        return plane_distance(points, scan.points, scan.normals, match(points, scan.points))

    assert off_the_scan(thick.points[0]) < 0.5 * off_the_scan(posed.points[0])
    assert thick.displacement.norm(dim=-1).mean() > 1.3 * slim.displacement.norm(dim=-1).mean()


def test_a_killed_run_ends_where_the_uninterrupted_one_does(scans, small_model, tmp_path):
    """Bit by bit, its statistics included."""
    whole, broken = fresh(small_model), fresh(small_model)
    train_points(whole, scans, config_of())

    def kill(step, _):
        if step == 5:
            raise Killed

    with pytest.raises(Killed):
        train_points(broken, scans, config_of(), checkpoint=tmp_path / "c.safetensors", watch=kill)
    resumed = fresh(small_model)
    result = train_points(resumed, scans, config_of(), checkpoint=tmp_path / "c.safetensors")
    assert result.resumed_at == 4
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name


def test_half_precision_learns_alike(scans, small_model):
    """The first losses agree to a few percent, and stay finite: the networks' rounding is small against the loss."""
    runs: dict[str, list[float]] = {"float32": [], "bfloat16": []}
    for precision, losses in runs.items():
        model = fresh(small_model)
        config = config_of(steps=4, precision=precision)
        train_points(model, scans, config, watch=lambda _, loss, losses=losses: losses.append(loss))
    assert runs["bfloat16"] == pytest.approx(runs["float32"], rel=0.05)


def test_normals_join_late():
    config = config_of(steps=100, normals_from=0.3)
    assert weights_at(29, config).normal == config.weights.normal * config.normals_before
    assert weights_at(30, config).normal == config.weights.normal
    assert weights_at(29, config).distance == weights_at(30, config).distance == 1e4


def test_the_end_of_a_run_looks_at_more():
    config = config_of(steps=100, dense_from=0.8, dense=2.5)
    assert looked_at(79, config) == config
    late = looked_at(80, config)
    assert (late.queries, late.scan_points) == (1000, 3750)
    assert looked_at(10**6, papers_training(100)).queries == papers_training(100).queries


def test_only_the_encoder_sees_jitter(scans):
    """What the encoder is shown is the body turned and built so; scan, points and frames T are those of the truth."""
    joints, shapes = len(scans.body.parents), scans.body.shape_count
    vectors, betas = torch.zeros(2, joints, 3), torch.zeros(2, shapes)
    vectors[:, scans.body.skeleton.index("LeftArm")] = 0.3
    heavier = betas.index_fill(1, torch.tensor([1]), 1.0)
    plain, same, turned, built = (
        scans.batch([0, 4], jitter)
        for jitter in (
            None,
            Jitter(axis_angle_to_matrix(torch.zeros(2, joints, 3)), betas),
            Jitter(axis_angle_to_matrix(vectors), betas),
            Jitter(axis_angle_to_matrix(torch.zeros(2, joints, 3)), heavier),
        )
    )
    torch.testing.assert_close(same.position_map, plain.position_map, atol=1e-6, rtol=0)
    for batch, pose, build in ((turned, True, False), (built, False, True)):
        moved = (batch.position_map - plain.position_map).unflatten(1, (2, 3)).norm(dim=2).amax((0, 2, 3))
        assert (moved > 0.02).tolist() == [pose, build]  # metres, and 4 mm of build
    for batch in (same, turned, built):
        assert torch.equal(batch.bodies.vertices, plain.bodies.vertices)
        assert torch.equal(batch.bodies.transforms, plain.bodies.transforms)
        assert torch.equal(batch.scans[1].points, plain.scans[1].points)


def test_thinning_is_a_subset(rng):
    scan = ScanFrame(torch.arange(30.0).reshape(10, 3), torch.arange(30.0).reshape(10, 3))
    few = thin(scan, 4, torch.Generator().manual_seed(0))
    assert len(few.points) == len(few.points.unique(dim=0)) == 4
    assert torch.equal(few.points, few.normals)
    assert thin(scan, 99, torch.Generator()) is scan


def test_the_papers_run():
    """401 epochs of 100 frames in fours."""
    assert papers_training(100).fit.steps == 401 * 25


def test_nothing_to_learn_from_is_refused(body):
    with pytest.raises(ValueError, match="there are no scans to learn from"):
        ScanSet.of(body, [])
