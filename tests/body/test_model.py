"""Laws of Eq. 3 and of the body that ships."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.body.model import Body, body_from_arrays
from workbench.body_evaluation import UNSEEN_SEED, sample_poses, skinning_error, statures
from workbench.geometry.rotations import axis_angle_to_matrix


def random_pose(body: Body, seed: int, spread: float = 0.2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return axis_angle_to_matrix(spread * torch.randn(len(body.parents), 3, generator=generator))


def test_the_default_body_is_one_closed_outward_surface(body):
    mesh = trimesh.Trimesh(body.template.numpy(), body.faces.numpy(), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert 0.045 < mesh.volume < 0.085  # cubic metres of a person; negative if inside out


def test_the_rest_stands_on_the_floor_faces_minus_y_with_straight_arms_at_45_degrees(body):
    assert abs(float(body.template[:, 2].min())) < 1e-5
    toes, heel = body.skeleton.index("LeftToeBase"), body.skeleton.index("LeftFoot")
    assert body.joint_template[toes, 1] < body.joint_template[heel, 1]
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        shoulder, elbow, wrist = (
            body.joint_template[body.skeleton.index(side + part)] for part in ("Arm", "ForeArm", "Hand")
        )
        along = torch.nn.functional.normalize(torch.stack([elbow - shoulder, wrist - elbow]), dim=-1)
        expected = torch.tensor([sign, 0.0, -1.0]) / 2**0.5
        assert torch.allclose(along, expected.expand(2, 3), atol=1e-3)


def test_statures_are_those_of_adults(body):
    betas = torch.randn(3000, body.shape_count, generator=torch.Generator().manual_seed(0))
    heights = statures(body, betas)
    assert 1.64 <= float(heights.mean()) <= 1.76
    assert 0.07 <= float(heights.std()) <= 0.11


def test_every_shape_stands_on_the_same_floor(body):
    betas = torch.randn(50, body.shape_count, generator=torch.Generator().manual_seed(0))
    vertices = body.vertices(body.rest_rotations(), betas)
    assert vertices[..., 2].amin(dim=-1).abs().max() < 0.01


def test_shape_is_linear(body):
    a, b = torch.randn(2, body.shape_count, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(body.shape_offsets(a + 2 * b), body.shape_offsets(a) + 2 * body.shape_offsets(b), atol=1e-5)
    assert torch.allclose(body.joints(0.5 * (a + b)), 0.5 * (body.joints(a) + body.joints(b)), atol=1e-5)


def test_rest_pose_and_mean_shape_give_the_template(body):
    for skinning in ("linear", "dual_quaternion"):
        posed = body.vertices(body.rest_rotations(), body.mean_shape(), skinning=skinning)
        assert torch.allclose(posed, body.template, atol=1e-5)


def test_translation_carries_the_whole_body(body):
    pose, shift = random_pose(body, 0), torch.tensor([1.0, -2.0, 0.5])
    still, moved = body.vertices(pose, body.mean_shape()), body.vertices(pose, body.mean_shape(), shift)
    assert torch.allclose(moved - still, shift.expand_as(still), atol=1e-5)
    assert torch.allclose(
        body.pose(pose, body.mean_shape(), shift).joints[0], body.joint_template[0] + shift, atol=1e-5
    )


def test_batched_frames_and_shapes_agree_with_single_ones(body):
    poses = torch.stack([random_pose(body, seed) for seed in range(3)])
    betas = torch.randn(3, body.shape_count, generator=torch.Generator().manual_seed(4))
    together = body.vertices(poses, betas)
    for frame in range(3):
        assert torch.allclose(together[frame], body.vertices(poses[frame], betas[frame]), atol=1e-5)
    assert torch.allclose(body.vertices(poses, betas[0])[1], body.vertices(poses[1], betas[0]), atol=1e-5)


def test_correctives_remove_most_of_the_gap_to_dual_quaternions_on_unseen_poses(body):
    error = skinning_error(body, sample_poses(body, 12, torch.Generator().manual_seed(UNSEEN_SEED)))
    assert error.reduction >= 0.60


def test_vertices_are_differentiable_in_shape_and_pose(body):
    few = torch.arange(0, len(body.template), 1500)
    small = body_from_arrays(
        {
            "name": np.array("few"),
            "template": body.template[few].numpy(),
            "shape_directions": body.shape_directions[:, few].numpy(),
            "pose_directions": body.pose_directions[:, few].numpy(),
            "pose_map": body.pose_map.numpy(),
            "weights": body.weights[few].numpy(),
            "joint_template": body.joint_template.numpy(),
            "joint_directions": body.joint_directions.numpy(),
            "faces": np.array([[0, 1, 2]]),
            "parents": np.array(body.parents),
            "joint_names": np.array(body.joint_names),
        }
    ).to(dtype=torch.float64)
    vectors = 0.3 * torch.randn(31, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    betas = torch.randn(10, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def some(b, v):
        return small.vertices(axis_angle_to_matrix(v), b)[:2]

    assert torch.autograd.gradcheck(some, (betas.requires_grad_(), vectors.requires_grad_()))


def test_saving_and_loading_returns_the_same_body(body, tmp_path):
    body.save(tmp_path / "body.npz")
    again = Body.load(tmp_path / "body.npz")
    pose = random_pose(body, 5)
    assert torch.allclose(again.vertices(pose, body.mean_shape()), body.vertices(pose, body.mean_shape()), atol=3e-5)
    assert again.joint_names == body.joint_names
    assert torch.equal(again.faces, body.faces)


def test_the_atlas_covers_every_face_inside_the_unit_square(body):
    assert body.uv is not None
    assert body.uv_faces is not None
    assert body.uv_faces.shape == body.faces.shape
    assert float(body.uv.min()) >= 0
    assert float(body.uv.max()) <= 1


def test_wrong_joint_and_shape_counts_are_named(body):
    with pytest.raises(ValueError, match="24 joints, but body 'default' has 31"):
        body.vertices(torch.eye(3).repeat(24, 1, 1), body.mean_shape())
    with pytest.raises(ValueError, match="betas have 16 components, but body 'default' has 10"):
        body.vertices(body.rest_rotations(), torch.zeros(16))


def test_unknown_skinning_is_refused(body):
    with pytest.raises((ValueError, TypeError), match="skinning"):
        body.vertices(body.rest_rotations(), body.mean_shape(), skinning="magic")


@pytest.mark.parametrize(
    ("key", "spoil", "message"),
    [
        ("template", lambda a: a[:-1], "template has shape"),
        ("joint_directions", lambda a: np.full_like(a, np.nan), "joint_directions holds NaN"),
        ("weights", lambda a: 2 * a, "skinning weights of vertex .* sum to 2.000"),
        ("faces", lambda a: a + 1, "faces index vertex 13348, but the mesh has 13348 vertices"),
        ("parents", lambda a: np.roll(a, 1), "comes before its parent"),
    ],
)
def test_a_damaged_body_file_is_refused_in_one_line(body, tmp_path, key, spoil, message):
    body.save(tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz") as file:
        arrays = dict(file)
    arrays[key] = spoil(arrays[key])
    np.savez(tmp_path / "spoiled.npz", **arrays)
    with pytest.raises(ValueError, match=message) as failure:
        Body.load(tmp_path / "spoiled.npz")
    assert "\n" not in str(failure.value)


def test_a_truncated_or_missing_file_is_named(body, tmp_path):
    body.save(tmp_path / "body.npz")
    cut = tmp_path / "cut.npz"
    cut.write_bytes((tmp_path / "body.npz").read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"cut\.npz is not readable as a body"):
        Body.load(cut)
    with pytest.raises(FileNotFoundError, match=r"no body file at .*nothing\.npz"):
        Body.load(tmp_path / "nothing.npz")
