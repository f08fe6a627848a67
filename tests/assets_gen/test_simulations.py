# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false
"""Laws of assets_gen.simulations, on a ball that moves under a cap of cloth."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from assets_gen.cloth_solver import ClothConfig
from assets_gen.simulations import (
    DEFAULT_SET,
    MADE_BY,
    BodyMotion,
    Judge,
    RecordConfig,
    SimulationsConfig,
    Task,
    approach_of,
    carried,
    heading,
    make,
    make_all,
    posed,
    report_line,
    run,
    simulate,
)
from workbench.body.model import Body, body_from_arrays
from workbench.collisions.sequences import SimulatedSequence
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.store import code_version, config_hash

RADIUS = 0.3


@pytest.fixture(scope="module")
def ball() -> Body:
    """A ball of one joint that moves and one that is not used; beta_0 blows it up."""
    mesh = trimesh.creation.icosphere(3, RADIUS)
    vertices = np.asarray(mesh.vertices)
    return body_from_arrays(
        {
            "name": np.array("ball"),
            "template": vertices,
            "shape_directions": np.stack([0.1 * vertices]),
            "pose_directions": np.zeros((1, len(vertices), 3)),
            "pose_map": np.zeros((9, 1)),
            "weights": np.tile([1.0, 0.0], (len(vertices), 1)),
            "joint_template": np.array([[0, 0, 0], [0, 0, 0.1]]),
            "joint_directions": np.zeros((1, 2, 3)),
            "faces": np.asarray(mesh.faces),
            "parents": np.array([-1, 0]),
            "joint_names": np.array(["root", "tip"]),
        }
    )


@pytest.fixture(scope="module")
def cap() -> Garment:
    """The upper part of a slightly larger ball."""
    mesh = trimesh.creation.icosphere(3, RADIUS + 0.02)
    keep = mesh.vertices[mesh.faces][:, :, 2].min(1) > -0.05
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    vertices = torch.tensor(mesh.vertices[used], dtype=torch.float32)
    return Garment("cap", vertices, vertices, torch.from_numpy(faces.reshape(-1, 3)).long())


def motion_of(body, frames=4, turn=0.3):
    angle = torch.linspace(0.5, 0.5 + turn, frames)
    axis = torch.tensor([0.0, 0.6, 0.8])
    rotations = torch.eye(3).repeat(frames, 2, 1, 1)
    rotations[:, 0] = axis_angle_to_matrix(angle[:, None] * axis)
    translation = torch.tensor([4.0, 1.0, 0.0]) + torch.arange(frames)[:, None] * torch.tensor([0.01, 0.0, 0.0])
    return Motion(rotations, translation, 30.0, body.skeleton, "roll")


QUICK = RecordConfig(approach=0.1, settle=0.05, cloth=ClothConfig(substeps=3))


def task_of(body, cap, name="a", record=QUICK, **changes):
    task = Task(name, motion_of(body), torch.tensor([0.3]), cap, clear=False, record=record)
    return dataclasses.replace(task, **changes)


@pytest.mark.simulation
def test_a_run_that_was_stopped_goes_on_to_the_same_result(ball, cap, tmp_path):
    tasks = [task_of(ball, cap, "a"), task_of(ball, cap, "b", betas=torch.tensor([-0.5]))]
    whole = SimulationsConfig(out=tmp_path / "whole", workers=1)
    files, failures = make_all(tasks, ball, whole)  # two are missing: through the local cluster
    assert failures == []
    parts = SimulationsConfig(out=tmp_path / "parts")

    class Stop(Exception):
        pass

    def stop(frames):
        raise Stop

    make_all(tasks[:1], ball, parts)
    with pytest.raises(Stop):
        make(tasks[1], ball, parts.out, code_version(*MADE_BY), stop)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").glob("*.npz")}
    assert len(before) == 1
    again, _ = make_all(tasks, ball, parts)
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())
    for one, other in zip(files, again, strict=True):
        first, second = SimulatedSequence.load(one), SimulatedSequence.load(other)
        assert one.name == other.name
        assert torch.equal(first.garment, second.garment)
        assert torch.equal(first.valid, second.valid)

    sequence = SimulatedSequence.load(files[0])
    assert bool(sequence.valid.all())
    assert len(sequence) == len(tasks[0].motion)
    centre = ball.joints(tasks[0].betas)[0] + sequence.translation
    distance = (sequence.garment - centre[:, None]).norm(dim=-1)
    assert distance.min() > RADIUS * 1.03  # outside of the blown-up ball
    assert distance.max() < RADIUS * 1.5  # and still on it, four metres from where it was draped
    assert "4 kept, 0 with vertices inside the body" in report_line(files[0])

    wild = task_of(ball, cap, "wild", record=dataclasses.replace(QUICK, cloth=ClothConfig(substeps=3, fastest=1e-4)))
    _, failures = make_all([wild], ball, parts)
    assert len(failures) == 1
    assert failures[0].startswith("wild: the simulation diverged at frame 1: ")
    assert "\n" not in failures[0]
    assert not list((tmp_path / "parts").glob("wild*.npz"))


def test_the_body_arrives_at_the_first_frame_and_shape(ball):
    motion, betas = motion_of(ball), torch.tensor([0.7])
    start, way = approach_of(motion, ball, betas, QUICK)
    last = list(posed(ball, way))[-1]
    first = ball.vertices(motion.rotations[0], betas, motion.translation[0]).numpy()
    assert np.allclose(last, first, atol=1e-5)
    assert torch.equal(start.betas, torch.zeros(1, 1))
    assert torch.allclose(start.rotations[0, 0] @ torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 1.0]))


def test_heading_is_the_turn_about_the_vertical():
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 2.5]))
    assert torch.allclose(heading(turn), turn, atol=1e-6)
    lean = axis_angle_to_matrix(torch.tensor([0.4, -0.3, 0.0]))
    assert torch.allclose(heading(lean), torch.eye(3), atol=1e-6)


def test_the_template_is_carried_with_the_body(ball, cap):
    start, _ = approach_of(motion_of(ball), ball, torch.zeros(1), QUICK)
    surface = ball.vertices(start.rotations[0], start.betas[0], start.translation[0])
    garment = carried(cap.vertices, ball, start)
    before = (cap.vertices[:, None] - ball.template).norm(dim=-1)
    assert torch.allclose((garment[:, None] - surface).norm(dim=-1), before, atol=1e-5)


def test_poses_come_in_order_across_batches(ball):
    T = 40
    motion = BodyMotion(
        torch.eye(3).repeat(T, 2, 1, 1), torch.zeros(T, 1), torch.arange(T)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    )
    assert [round(float(surface[:, 0].mean())) for surface in posed(ball, motion)] == list(range(T))


def test_the_judge_sees_vertices_inside_and_torn_cloth(ball, cap):
    judge = Judge.of(cap, ball.template.numpy(), ball.faces.numpy(), QUICK)
    good = judge(cap.vertices.numpy(), ball.template.numpy())
    assert good.valid
    assert good.usual_stretch == pytest.approx(1.0, abs=1e-3)
    sunk = cap.vertices.clone()
    sunk[5] *= 0.9
    assert judge(sunk.numpy(), ball.template.numpy()).inside == 1
    assert not judge(sunk.numpy(), ball.template.numpy()).valid
    allowed = replace(judge, record=replace(QUICK, most_inside=1.5 / len(sunk)))
    assert allowed(sunk.numpy(), ball.template.numpy()).valid
    sunk[6] *= 0.9
    assert not allowed(sunk.numpy(), ball.template.numpy()).valid
    torn = judge((cap.vertices * 2.5).numpy(), ball.template.numpy())
    assert torn.usual_stretch == pytest.approx(2.5, rel=1e-3)
    assert not torn.valid


def test_what_makes_a_result_names_it(ball, cap):
    task = task_of(ball, cap)
    others = [
        task_of(ball, cap, betas=torch.tensor([0.31])),
        task_of(ball, cap, motion=motion_of(ball, turn=0.31)),
        task_of(ball, cap, record=RecordConfig()),
        task_of(ball, cap, clear=True),
        task_of(ball, cap, garment=dataclasses.replace(cap, vertices=cap.vertices + 1e-4)),
    ]
    names = {config_hash(other.made_from()) for other in [task, *others]}
    assert len(names) == 1 + len(others)
    assert config_hash(task_of(ball, cap).made_from()) == config_hash(task.made_from())


def test_the_default_set_is_as_large_as_promised():
    frames = {kind: sum(p.frames for p in DEFAULT_SET if p.garment == kind) for kind in ("tshirt", "dress")}
    assert frames["tshirt"] >= 600
    assert frames["dress"] >= 300
    assert len({p.shape for p in DEFAULT_SET}) == 3
    assert len({p.name for p in DEFAULT_SET}) == len(DEFAULT_SET)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"motion": "walk_00", "frames": 9999}, r"walk_00 has \d+ frames at 30 fps; got frames 0 to 9999"),
        ({"motion": "walk_00", "betas": (0.0,) * 11}, "betas must be at most 10 finite numbers"),
        ({"motion": "walk_00", "betas": (math.nan,)}, "betas must be at most 10 finite numbers"),
        ({"motion": "moonwalk_00"}, "no motion is called 'moonwalk_00'"),
    ],
)
def test_unusable_wishes_get_one_line(changes, says, tmp_path):
    with pytest.raises(ValueError, match=says) as caught:
        run(SimulationsConfig(out=tmp_path, **changes))
    assert "\n" not in str(caught.value)


def test_another_frame_rate_is_refused(ball, cap):
    slow = dataclasses.replace(motion_of(ball), fps=25.0)
    with pytest.raises(ValueError, match="the motion has 25 fps; simulations run at 30"):
        simulate(task_of(ball, cap, motion=slow), ball)
