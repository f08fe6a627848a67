"""Laws of the poses that a corrective learns from."""

import torch

from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.regressor import Regressor
from workbench.collisions.worn_poses import SHAPE_CUT, Wearer, WornPoses, with_room
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion


def wearer(body, folder, **options) -> Wearer:
    regressor = Regressor("tshirt", len(body.parents), body.shape_count, 30.0)
    return Wearer(body, regressor, **{"shapes": 2, "every": 4, "seed": 1, "kept": folder, **options})


def still(body, name: str, frames: int = 6) -> Motion:
    rotations = body.rest_rotations()[None].repeat(frames, 1, 1, 1)
    return Motion(rotations, torch.zeros(frames, 3), 30.0, body.skeleton, name)


def test_every_motion_meets_its_shapes_and_one_frame_in_so_many_is_kept(body, tmp_path):
    wear = wearer(body, tmp_path)
    motions = [still(body, "a"), still(body, "b", 9)]
    worn = wear(motions)
    assert len(worn) == 2 * 2 + 2 * 3
    expected = [b for m, count in zip(motions, (2, 3), strict=True) for b in wear.shapes_of(m) for _ in range(count)]
    torch.testing.assert_close(worn.betas, torch.stack(expected))
    assert float(worn.betas.abs().max()) <= SHAPE_CUT
    torch.testing.assert_close(worn.rotations, body.rest_rotations().expand_as(worn.rotations))


def test_shapes_are_those_of_the_name_whatever_else_is_worn(body, tmp_path):
    one, other = wearer(body, tmp_path), wearer(body, tmp_path, seed=2)
    a, b = still(body, "a"), still(body, "b")
    torch.testing.assert_close(one.shapes_of(a), wearer(body, tmp_path).shapes_of(a))
    assert not torch.allclose(one.shapes_of(a), one.shapes_of(b))
    assert not torch.allclose(one.shapes_of(a), other.shapes_of(a))


def test_a_motion_is_cleared_once_for_a_shape_and_for_all_garments(body, tmp_path, monkeypatch):
    cleared = []
    plain = Motion.cleared
    monkeypatch.setattr(Motion, "cleared", lambda self, *a, **k: cleared.append(self.name) or plain(self, *a, **k))
    first = wearer(body, tmp_path)([still(body, "a")])
    again = wearer(body, tmp_path)([still(body, "a"), still(body, "b")])
    assert sorted(cleared) == ["a", "a", "b", "b"]
    torch.testing.assert_close(again.rotations[: len(first)], first.rotations, atol=1e-6, rtol=0)


def test_sets_are_joined_in_their_order(body):
    parts = [WornPoses(torch.rand(n, 3, 3, 3), torch.rand(n, 10), torch.rand(n, 25)) for n in (2, 3)]
    both = WornPoses.joined(parts)
    assert len(both) == 5
    torch.testing.assert_close(both[torch.arange(2, 5)].latents, parts[1].latents)


def test_motions_are_worn_as_they_are_on_one_shape(body, tmp_path):
    wear, motion = wearer(body, tmp_path), still(body, "a")
    motion.rotations[:, body.joint_names.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 1.4, 0.0]))
    worn = wear.uncleared([motion])
    torch.testing.assert_close(worn.rotations, motion.rotations[::4])
    torch.testing.assert_close(worn.betas, wear.shapes_of(motion)[:1].expand(2, -1))


def test_poses_stay_that_leave_cloth_room_and_the_fewer_the_more_it_needs(body):
    """An arm nears the flank until it is in it."""
    angles = torch.linspace(0.2, 1.4, 13)
    rotations = body.rest_rotations()[None].repeat(len(angles), 1, 1, 1)
    arm = body.joint_names.index("LeftArm")
    rotations[:, arm] = axis_angle_to_matrix(angles[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    worn = WornPoses(rotations, torch.zeros(len(angles), body.shape_count), torch.zeros(len(angles), 25))
    model, shirt = GarmentModel(body, GridFields.default()), Garment.load("tshirt").vertices

    def cloth(some: WornPoses) -> torch.Tensor:
        return model.posed(shirt.expand(len(some), -1, -1), model.state(some.rotations, some.betas))

    kept = [with_room(worn, cloth, body, gap) for gap in (0.0, 0.01, 0.02)]
    assert len(angles) > len(kept[0]) > len(kept[1]) > len(kept[2]) > 0
    for some in kept:
        torch.testing.assert_close(some.rotations, worn.rotations[: len(some)])
