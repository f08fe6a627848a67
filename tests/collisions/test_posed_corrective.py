"""Laws of the corrective against collisions in posed space, small and hardly trained."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from workbench.collisions.diffused_body import GridFields
from workbench.collisions.limb_sight import LimbSight
from workbench.collisions.penetration import penetration
from workbench.collisions.posed_corrective import (
    EASY_STRETCH,
    FOLDED,
    REACH,
    CorrectiveTraining,
    PosedCorrective,
    TrainCorrectiveConfig,
    run,
    train,
    within_reach,
)
from workbench.collisions.regressor import Regressor
from workbench.collisions.subspace import NetworkConfig, Statistics, Subspace
from workbench.collisions.tryon import TryOn, load_tryon
from workbench.collisions.worn_poses import SHAPE_CUT, Jitter, WornPoses
from workbench.garments import Garment
from workbench.geometry.patches import Patches
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning.fit import FitConfig
from workbench.motion import Motion

NETWORK = NetworkConfig(width=32, depth=2, rank=30)


@pytest.fixture(scope="module")
def config(small_set, body, tmp_path_factory) -> TrainCorrectiveConfig:
    folder: Path = tmp_path_factory.mktemp("networks")
    small_set.save(folder / "set.npz")
    Subspace("tshirt", Statistics.of(small_set, NETWORK), NETWORK).save(folder / "tshirt-subspace.safetensors")
    regressor = Regressor("tshirt", len(body.parents), body.shape_count, 30.0)
    regressor.standardise(small_set.of_split("train"))
    regressor.save(folder / "tshirt-regressor.safetensors")
    return TrainCorrectiveConfig(
        data=folder / "set.npz",
        out=folder,
        patches=6,
        rank=8,
        width=32,
        shapes_a_motion=1,
        every=6,
        first_frames=8,
        round_poses=6,
        round_steps=2,
        batch=2,
        fit=FitConfig(steps=4, learning_rate=1e-2, warmup=1),
    )


def closed_arms(body, count: int) -> WornPoses:
    """Arms pressed into the flanks: the template must end inside."""
    rotations = body.rest_rotations()[None].repeat(count, 1, 1, 1)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        rotations[:, body.joint_names.index(f"{side}Arm")] = axis_angle_to_matrix(torch.tensor([0.0, 0.75 * sign, 0.0]))
    return WornPoses(rotations, torch.zeros(count, body.shape_count), torch.zeros(count, 25))


def drawn(body, vertices: int = 50, patches: Patches | None = None, *, name: str = "tshirt", seed: int = 0):
    """A corrective of some points about the trunk, by chance but for its last layer."""
    chance = torch.Generator().manual_seed(seed)
    points = torch.tensor([0.0, 0.0, 1.2]) + 0.2 * torch.randn(vertices, 3, generator=chance)
    patches = patches or Patches.of(points, 4)
    sight = LimbSight.of(body, GridFields.default(), points[: len(patches)])
    basis = torch.randn(6, 3 * patches.vertices.numel(), generator=chance)
    return PosedCorrective(name, patches, sight, basis, width=16, generator=chance)


def test_it_begins_by_correcting_nothing_and_does_not_see_the_root(body):
    corrective = drawn(body)
    pose = axis_angle_to_matrix(0.3 * torch.randn(4, len(body.parents), 3))
    given = (torch.randn(4, body.shape_count), torch.randn(4, 25))
    assert not corrective(pose, *given).any()
    torch.nn.init.normal_(corrective.last)
    turned = pose.clone()
    turned[:, 0] = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(corrective(turned, *given), corrective(pose, *given))
    bent = pose.clone()
    bent[:, body.joint_names.index("LeftArm")] = turned[:, 0]
    assert not torch.equal(corrective(bent, *given), corrective(pose, *given))


def test_an_offset_beyond_its_reach_keeps_its_direction_and_loses_the_rest():
    offset = torch.randn(5, 50, 3, generator=torch.Generator().manual_seed(0))
    wanted = torch.tensor([0.0, 0.3, 0.99, 1.5, 40.0]) * REACH
    sized = offset * (wanted / offset.square().sum(-1).mean(-1).sqrt())[:, None, None]
    held = sized * within_reach(sized)[:, None, None]
    torch.testing.assert_close(held.square().sum(-1).mean(-1).sqrt(), wanted.clamp(max=REACH), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(held[:3], sized[:3])
    torch.testing.assert_close(held[3:] / REACH, sized[3:] / wanted[3:, None, None], atol=1e-4, rtol=1e-4)


def test_what_is_needed_brings_vertices_out(config, body):
    """A garment that is too narrow, at rest: nothing folds there, so the way out is nearly exact."""
    training = CorrectiveTraining.of(config)
    training.subspace.decoder.middle.data *= torch.tensor([0.95, 0.95, 1.0]).repeat(training.subspace.vertex_count)
    worn = WornPoses(body.rest_rotations()[None], torch.zeros(1, body.shape_count), torch.zeros(1, 25))
    with torch.no_grad():
        X = training.subspace.decode(worn.latents)
    needed = training.needed(worn)
    state, bodies = training.model.state(worn.rotations, worn.betas), body.vertices(worn.rotations, worn.betas)
    local = training.model.local_map(X, state)
    before, after = (penetration(bodies, body.faces, local.posed(shape)).share for shape in (X, X + needed))
    assert before > 0.02
    assert after < 0.1 * before
    untouched = training.distance.between(local.posed(X), bodies) >= training.config.weights.posed_clearance
    assert not needed[untouched].any()


def test_learning_frees_vertices(config, body):
    training, worn = CorrectiveTraining.of(config), closed_arms(body, 2)
    corrective = training.begin(worn)
    optimizer = torch.optim.Adam(corrective.parameters(), lr=1e-2)
    first = float(training.loss(corrective, training.contacts(corrective, worn), torch.Generator()).detach())
    for _ in range(2):
        contacts = training.contacts(corrective, worn)
        for _ in range(12):
            optimizer.zero_grad()
            loss = training.loss(corrective, contacts, torch.Generator())
            loss.backward()
            optimizer.step()
    assert (
        float(training.loss(corrective, training.contacts(corrective, worn), torch.Generator()).detach()) < 0.5 * first
    )


def test_training_writes_a_corrective_that_loads_continues_and_is_used(config, body, small_set):
    first, again = run(config), run(config)
    back = PosedCorrective.load(config.out / "tshirt-corrective.safetensors")
    for name, tensor in first.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor)
        if name == "basis":  # int8, a step a column; then half precision
            off = (back.state_dict()[name] - tensor).abs()
            assert (off <= tensor.abs().amax(dim=0) * (0.5 / 127 + 1e-3) + 1e-6).all()
        else:
            torch.testing.assert_close(back.state_dict()[name], tensor, atol=2e-2, rtol=2e-3)
    assert [entry["step"] for entry in back.story["curves"]] == [2, 4]
    tryon = load_tryon("tshirt", config.out)
    assert tryon.corrective is not None
    s = small_set.sequences[0]
    motion, betas = Motion(s.rotations[:6], s.translation[:6], 30.0, body.skeleton), torch.zeros(10)
    result, bare = tryon.run(motion, betas), replace(tryon, corrective=None).run(motion, betas)
    offset = tryon.corrective(motion.rotations, betas.expand(6, -1), result.latent)
    torch.testing.assert_close(result.canonical, bare.canonical + offset, atol=1e-6, rtol=1e-5)
    stream = tryon.stream(betas)
    for t in range(6):
        frame = stream(motion.rotations[t], motion.translation[t])
        torch.testing.assert_close(frame.canonical, result.canonical[t], atol=1e-4, rtol=1e-4)


def test_foreign_and_damaged_files_are_refused(tmp_path, config, body):
    with pytest.raises(FileNotFoundError, match="workbench train corrective"):
        PosedCorrective.load(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match="is damaged"):
        PosedCorrective.load(tmp_path / "bad.safetensors")
    with pytest.raises(ValueError, match="is no corrective"):
        PosedCorrective.load(config.out / "tshirt-regressor.safetensors")
    other = drawn(body, name="dress")
    patches = other.patches
    for broken in (
        Patches(patches.vertices + 1, patches.windows),
        Patches(patches.vertices, patches.windows * float("nan")),
        Patches(patches.vertices[:1], patches.windows[:1]),
    ):
        other.patches = broken
        other.save(tmp_path / "odd.safetensors")
        with pytest.raises(ValueError, match=r"odd.safetensors is damaged \(patches .* `workbench train corrective`"):
            PosedCorrective.load(tmp_path / "odd.safetensors")
    other.patches = patches
    other.save(tmp_path / "whole.safetensors")
    with safe_open(tmp_path / "whole.safetensors", framework="pt") as file:
        tensors, metadata = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118  not a dict
    odd = {**tensors, "sight.ends": tensors["sight.ends"] + 100}
    save_file(odd, tmp_path / "odd.safetensors", metadata=metadata)
    with pytest.raises(ValueError, match=r"odd.safetensors is damaged \(bones that end at no joint"):
        PosedCorrective.load(tmp_path / "odd.safetensors")
    save_file(tensors, tmp_path / "odd.safetensors", metadata={**metadata, "parents": json.dumps([40] * 31)})
    with pytest.raises(ValueError, match=r"odd.safetensors is damaged \(joints that hang on none"):
        PosedCorrective.load(tmp_path / "odd.safetensors")
    del tensors["last"]
    save_file(tensors, tmp_path / "part.safetensors", metadata=metadata)
    with pytest.raises(ValueError, match=r"part.safetensors is damaged .*last"):
        PosedCorrective.load(tmp_path / "part.safetensors")
    save_file(tensors, tmp_path / "old.safetensors", metadata={**metadata, "format": "corrective-1"})
    with pytest.raises(ValueError, match="expected 'corrective-2'.*workbench train corrective"):
        PosedCorrective.load(tmp_path / "old.safetensors")
    networks = (
        Subspace.load(config.out / "tshirt-subspace.safetensors"),
        Regressor.load(config.out / "tshirt-regressor.safetensors"),
    )
    with pytest.raises(ValueError, match="trained together"):
        TryOn.of(*networks, corrective=other)
    assert PosedCorrective.beside(tmp_path, "tshirt") is None


def test_further_motions_are_worn_in_training_alone(config, body, tmp_path):
    training = CorrectiveTraining.of(replace(config, motions=(tmp_path,)))
    plain = CorrectiveTraining.of(config)
    rotations = body.rest_rotations()[None].repeat(6, 1, 1, 1)
    Motion(rotations, torch.zeros(6, 3), 30.0, body.skeleton, "still").save(tmp_path / "still.npz")
    count = {name: (len(t.wear("train")), len(t.wear("validation"))) for name, t in (("a", training), ("b", plain))}
    assert count["a"][0] - count["b"][0] == -(-6 // config.every) * config.shapes_a_motion
    assert count["a"][1] == count["b"][1]


def test_jitter_leaves_the_root_and_without_it_everything(body):
    worn = closed_arms(body, 3)
    chance = torch.Generator().manual_seed(4)
    same = worn.jittered(Jitter(0.0, 0.0, 0.0), chance)
    torch.testing.assert_close((same.rotations, same.betas, same.latents), (worn.rotations, worn.betas, worn.latents))
    other = worn.jittered(Jitter(pose=0.1, shape=9.0, latent=0.5), chance)
    torch.testing.assert_close(other.rotations[:, 0], worn.rotations[:, 0])
    turned = worn.rotations.mT @ other.rotations
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3).expand_as(turned), atol=1e-5, rtol=0)
    angle = torch.arccos(((turned[:, 1:].diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    assert 0.1 < float(angle.square().mean().sqrt()) < 0.3  # three components of 0.1 each: 0.17
    assert float(other.betas.abs().max()) == SHAPE_CUT


def test_it_begins_with_another_where_one_is_given(config, body, tmp_path):
    first = run(config)
    for name in ("tshirt-subspace.safetensors", "tshirt-regressor.safetensors"):
        shutil.copy(config.out / name, tmp_path)
    slow = replace(config.fit, learning_rate=1e-9, last_rate=1e-9)
    given = config.out / "tshirt-corrective.safetensors"
    again = run(replace(config, out=tmp_path, seed=config.seed + 1, fit=slow, start=given))
    for name, tensor in PosedCorrective.load(given).state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor, atol=1e-5, rtol=1e-5)
    assert again.story["start"]["curves"] == first.story["curves"]
    assert len(again.basis) == len(first.basis)
    drawn(body, name="dress").save(tmp_path / "dress")
    with pytest.raises(ValueError, match="is a corrective of 'dress'"):
        run(replace(config, start=tmp_path / "dress"))


def test_uncleared_motions_are_worn_where_they_leave_room(config, body, tmp_path):
    rotations = body.rest_rotations()[None].repeat(12, 1, 1, 1)
    for joint, turn in (("LowerBack", (2.6, 0, 0)), ("LeftArm", (0, 1.4, 0)), ("RightArm", (0, -1.4, 0))):
        # the chest in the thighs, the arms deep in the flanks
        rotations[6:, body.joint_names.index(joint)] = axis_angle_to_matrix(torch.tensor(turn).float())
    Motion(rotations, torch.zeros(12, 3), 30.0, body.skeleton, "half").save(tmp_path / "half.npz")
    plain = CorrectiveTraining.of(config).wear("train")
    more = CorrectiveTraining.of(replace(config, uncleared=(tmp_path,))).wear("train")
    assert len(more) - len(plain) == -(-6 // config.every)
    torch.testing.assert_close(more.rotations[-1], rotations[0])


def test_folded_bodies_are_cleared_and_worn_though_they_still_overlap_a_little(config, body, tmp_path):
    rotations = body.rest_rotations()[None].repeat(12, 1, 1, 1)
    rotations[:, body.joint_names.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 1.4, 0.0]))
    bent = {"LowerBack": 0.45, "Spine": 0.45, "Spine1": 0.45, "LeftUpLeg": -2.1, "RightUpLeg": -2.1}
    for joint, turn in bent.items():
        rotations[6:, body.joint_names.index(joint)] = axis_angle_to_matrix(torch.tensor([turn, 0.0, 0.0]))
    Motion(rotations, torch.zeros(12, 3), 30.0, body.skeleton, "half").save(tmp_path / "half.npz")
    training = CorrectiveTraining.of(replace(config, close=(tmp_path,)))
    plain = CorrectiveTraining.of(config).wear("train")
    added = training.wear("train")[torch.arange(len(plain), len(plain) + 12 // config.every)]
    assert len(added) == 12 // config.every
    bodies = body.vertices(added.rotations, added.betas)
    overlap = penetration(bodies, body.faces, training.garments(added).detach()).overlap.float().mean(dim=1)
    assert float(overlap.max()) <= 1.5 * FOLDED  # of all vertices: one in four was looked at
    arm = body.joint_names.index("LeftArm")
    assert not torch.allclose(added.rotations[0, arm], rotations[0, arm], atol=0.1)  # off the flank


def test_an_offset_beyond_its_reach_is_still_made_smaller(config, body):
    """What is held to its reach may not hide how large it would be."""
    training, worn = CorrectiveTraining.of(config), closed_arms(body, 2)
    corrective = training.begin(worn)
    torch.nn.init.normal_(corrective.last, std=5.0, generator=torch.Generator().manual_seed(1))
    contacts = training.contacts(corrective, worn)
    far = float(corrective.unbounded(worn.rotations, worn.betas, worn.latents).detach().square().sum(-1).mean().sqrt())
    assert far > 2 * REACH
    only = replace(config.weights, hinge=0.0, canonical=0.0, laplacian=0.0, stretch=0.0)
    replace(training, config=replace(config, weights=only)).loss(corrective, contacts, torch.Generator()).backward()
    assert float(corrective.basis.grad.norm()) > 0  # pyright: ignore[reportOptionalMemberAccess]


def test_cloth_may_give_a_little_but_not_be_drawn_long(config):
    """An offset that moves all cloth as one stretches nothing; twice the excess of another costs four times."""
    training, garment = CorrectiveTraining.of(config), Garment.load("tshirt")
    rest = 1e3 * garment.rest_vertices[None]
    rigid = torch.tensor([30.0, -20.0, 10.0]).expand_as(rest)
    assert float(training.stretch(rigid, torch.Generator())) == 0
    assert float(training.stretch(0.9 * EASY_STRETCH * rest, torch.Generator())) == 0
    once, twice = (float(training.stretch(x * rest, torch.Generator())) for x in (EASY_STRETCH + 0.5, EASY_STRETCH + 1))
    assert once == pytest.approx(0.25, rel=1e-3)
    assert twice == pytest.approx(4 * once, rel=1e-3)


def test_motions_without_room_for_the_garment_are_refused(config, body, tmp_path):
    training, worn = CorrectiveTraining.of(config), closed_arms(body, 2)
    with pytest.raises(ValueError, match="no pose of the train motions leaves room for the tshirt"):
        train(training, {"train": worn[torch.arange(0)], "validation": worn}, tmp_path)


def test_an_interrupted_training_ends_like_a_whole_one(config, tmp_path):
    """It is stopped in its third round, looks at contacts anew, and sees the same."""
    for folder in (tmp_path / "whole", tmp_path / "parts"):
        folder.mkdir()
        for name in ("tshirt-subspace.safetensors", "tshirt-regressor.safetensors"):
            shutil.copy(config.out / name, folder)
    longer = replace(config, fit=replace(config.fit, steps=8))
    whole = run(replace(longer, out=tmp_path / "whole"))
    looks, look = [], CorrectiveTraining.contacts

    def interrupted(self, *given):
        looks.append(0)
        if len(looks) == 3:
            raise KeyboardInterrupt
        return look(self, *given)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(CorrectiveTraining, "contacts", interrupted)
        run(replace(longer, out=tmp_path / "parts"))
    parts = run(replace(longer, out=tmp_path / "parts"))
    for name, tensor in whole.state_dict().items():
        torch.testing.assert_close(parts.state_dict()[name], tensor, atol=0, rtol=0)
    assert [entry["step"] for entry in parts.story["curves"]] == [2, 4, 6, 8]
