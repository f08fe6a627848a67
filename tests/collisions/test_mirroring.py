"""Laws of left and right exchanged."""

from dataclasses import replace

import pytest
import torch

from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.mirroring import ACROSS, OFF, BodyMirror, GarmentMirror, with_mirrored
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint

LATE = slice(-2, None)  # by then limbs have wandered far enough from symmetry


def garment_mirror(garment: Garment) -> GarmentMirror:
    mirror = GarmentMirror.of(garment)
    assert mirror is not None
    return mirror


def body_mirror(body: Body) -> BodyMirror:
    mirror = BodyMirror.of(body)
    assert mirror is not None
    return mirror


def off_skin(points: torch.Tensor, vertices: torch.Tensor, body: Body) -> float:
    surface = ClosestPoint(vertices.numpy(), body.faces.int().numpy())
    return float(surface.query(points.numpy()).distance.max())


def test_the_mirrored_pose_is_the_mirror_image_of_the_body(body, small_set):
    s, mirror, across = small_set.sequences[0], body_mirror(body), torch.tensor(ACROSS)
    skins = body.vertices(s.rotations[LATE], s.betas, s.translation[LATE])
    images = body.vertices(mirror.rotations(s.rotations[LATE]), s.betas, mirror.translation(s.translation[LATE]))
    for skin, image in zip(skins, images, strict=True):
        assert off_skin(skin * across, image, body) < OFF
        assert off_skin(skin, image, body) > 10 * OFF  # this pose is not symmetric


def test_a_mirror_of_a_mirror_shows_what_is(body, small_set):
    s, mirror = small_set.sequences[0], body_mirror(body)
    torch.testing.assert_close(mirror.rotations(mirror.rotations(s.rotations)), s.rotations)
    for name in ("tshirt", "dress"):
        garment = Garment.load(name)
        of_garment = garment_mirror(garment)
        apart = (of_garment(of_garment(garment.vertices)) - garment.vertices).norm(dim=-1)
        assert float(apart.mean()) < 1e-3


@pytest.mark.parametrize("name", ["tshirt", "dress"])
def test_what_is_posed_and_mirrored_is_what_is_mirrored_and_posed(body, small_set, name):
    garment, s, of_body = Garment.load(name), small_set.sequences[0], body_mirror(body)
    of_garment, model = garment_mirror(garment), GarmentModel(body, GridFields.default())
    X = garment.vertices * torch.tensor([1.02, 1.05, 1.0]) + torch.tensor([0.004, 0.0, 0.0])
    posed = model.posed(X[None], model.state(s.rotations[-1:], s.betas, s.translation[-1:]))
    turned, moved = of_body.rotations(s.rotations[-1:]), of_body.translation(s.translation[-1:])
    image = model.posed(of_garment(X)[None], model.state(turned, s.betas, moved))
    apart = (of_garment(posed) - image).norm(dim=-1)
    assert float(apart.mean()) < 1.5e-3
    assert float((posed - image).norm(dim=-1).mean()) > 0.1


def test_training_sequences_double_and_stay_what_they_were(body, small_set):
    doubled = with_mirrored(small_set, body)
    assert [s.split for s in doubled.sequences] == ["train", "train", "validation", "train", "train"]
    mirror = garment_mirror(small_set.garment)
    for old, new in zip(small_set.sequences, doubled.sequences, strict=False):
        X = small_set.garments(old.coefficients)
        torch.testing.assert_close(doubled.garments(new.coefficients), X, atol=1e-5, rtol=0)
        torch.testing.assert_close(new.rotations, old.rotations)
    for old, new in zip(small_set.sequences[:2], doubled.sequences[3:], strict=True):
        X = mirror(small_set.garments(old.coefficients))
        torch.testing.assert_close(doubled.garments(new.coefficients), X, atol=1e-5, rtol=0)
        assert bool((new.valid == old.valid).all())
    gram = doubled.flat_basis @ doubled.flat_basis.T / len(doubled.mean)
    torch.testing.assert_close(gram, torch.eye(len(gram)), atol=1e-4, rtol=0)


def test_components_are_those_of_the_training_frames_alone(body, small_set):
    doubled = with_mirrored(small_set, body)
    size = doubled.kept("train").square().mean(0)
    assert bool((size[1:] <= size[:-1] * 1.001 + 1e-12).all())
    wild = replace(small_set.sequences[2], coefficients=100 * small_set.sequences[2].coefficients)
    other = with_mirrored(replace(small_set, sequences=(*small_set.sequences[:2], wild)), body)
    torch.testing.assert_close(other.basis, doubled.basis)


def test_what_is_not_symmetric_is_left_alone(body, small_set):
    garment = small_set.garment
    one_sided = replace(garment, vertices=garment.vertices + torch.tensor([0.05, 0.0, 0.0]))
    assert GarmentMirror.of(one_sided) is None
    askew = replace(small_set, garment_name="askew", own_garment=one_sided)
    assert with_mirrored(askew, body) is askew
    named = replace(body, joint_names=tuple(f"joint_{i}" for i in range(len(body.joint_names))))
    assert BodyMirror.of(named) is None
    assert with_mirrored(small_set, named) is small_set
