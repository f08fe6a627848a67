"""A garment that does not ship, from its training set to evaluation: it travels with what is trained for it."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from assets_gen.dataset import DatasetConfig
from assets_gen.dataset import run as make_dataset
from workbench.collisions.canonical_set import CanonicalSet
from workbench.collisions.collision_evaluation import CollisionEvaluation
from workbench.collisions.collision_evaluation import rows as collision_rows
from workbench.collisions.posed_corrective import TrainCorrectiveConfig
from workbench.collisions.posed_corrective import run as train_corrective
from workbench.collisions.regressor import TrainRegressorConfig
from workbench.collisions.regressor import run as train_regressor
from workbench.collisions.sequences import SimulatedSequence
from workbench.collisions.subspace import NetworkConfig, Subspace, TrainSubspaceConfig
from workbench.collisions.subspace import run as train_subspace
from workbench.collisions.subspace_evaluation import SubspaceEvaluation
from workbench.collisions.subspace_evaluation import rows as subspace_rows
from workbench.collisions.tryon import load_tryon
from workbench.formats import load_motion, motion_files
from workbench.formats.mesh_sequence import Mesh, write_mesh
from workbench.garments import Garment
from workbench.learning.fit import FitConfig

FEW = FitConfig(steps=2, warmup=1, checkpoint_every=2)


@dataclass(frozen=True)
class Trained:
    """Where the networks of a garment lie, and the garment."""

    folder: Path
    garment: Garment


def vest() -> Garment:
    """The T-shirt with its vertices in another order: who takes the T-shirt's template or faces for it, is found."""
    shirt = Garment.load("tshirt")
    order = torch.randperm(len(shirt.vertices), generator=torch.Generator().manual_seed(4))
    return Garment("vest", shirt.vertices[order], shirt.rest_vertices[order], order.argsort()[shirt.faces])


@pytest.fixture(scope="module")
def trained(small_set, tmp_path_factory) -> Trained:
    folder: Path = tmp_path_factory.mktemp("own")
    garment = vest()
    order = torch.randperm(len(garment.vertices), generator=torch.Generator().manual_seed(4))
    own = replace(
        small_set,
        garment_name="vest",
        mean=small_set.mean[order],
        basis=small_set.basis[:, order].contiguous(),
        own_garment=garment,
    )
    own.save(folder / "vest.npz")
    given = {"data": folder / "vest.npz", "out": folder, "fit": FEW}
    train_subspace(TrainSubspaceConfig(**given, network=NetworkConfig(width=32, depth=2, rank=30), batch=4))
    train_regressor(TrainRegressorConfig(**given, describe=FEW, window=10, batch=3))
    small = TrainCorrectiveConfig(rank=8, width=32, shapes_a_motion=1, every=6, first_frames=8, round_poses=6, batch=2)
    train_corrective(replace(small, round_steps=2, **given))
    return Trained(folder, garment)


def test_it_is_dressed_with_its_own_template_and_faces(trained, body):
    tryon = load_tryon("vest", trained.folder)
    assert tryon.garment.name == "vest"
    for key, tensor in trained.garment.tensors().items():
        assert tryon.garment.tensors()[key].equal(tensor)
    motion = load_motion(motion_files(None)[0], body).clip(0, 4)
    result = tryon.run(motion, body.mean_shape())
    assert result.garment_faces.equal(trained.garment.faces)
    near = (result.canonical - trained.garment.vertices).norm(dim=-1).mean()
    assert float(near) < 0.05  # metres: the order of its vertices, not the T-shirt's


def test_it_is_evaluated_against_its_own_set_and_simulations(trained, body, tmp_path):
    motion = load_motion(motion_files(None)[0], body).clip(0, 8)
    motion.save(tmp_path / "short.npz")
    tryon = load_tryon("vest", trained.folder)
    dressed = tryon.run(motion, body.mean_shape())
    simulated = SimulatedSequence(
        garment=dressed.garment,
        rotations=dressed.motion.rotations,
        translation=dressed.motion.translation,
        betas=dressed.betas,
        faces=dressed.garment_faces,
        valid=torch.ones(len(dressed.latent), dtype=torch.bool),
        fps=30.0,
        garment_name="vest",
        motion_name="test_short_00",
        made_by="this test",
    )
    simulated.save(tmp_path / "vest-test_short_00-0.npz")
    few = {"networks": trained.folder, "sequences": tmp_path}
    data = trained.folder / "vest.npz"
    there = {row.metric: row.value for row in subspace_rows(SubspaceEvaluation(**few, data=data, samples=8))}
    assert there["vest: the same error of the mean garment"] < 50
    config = CollisionEvaluation(**few, shapes=1, shapes_a_motion=1, every=60, raw=False, figures=False)
    table = {row.metric: row.value for row in collision_rows(config)}
    own = "vest, full with the posed-space corrective"
    assert table[f"{own}: frames compared with simulation"] > 0
    assert table[f"{own}: vertex error on unseen sequences, mean"] < 0.5  # mm: this "simulation" is the model's own


def test_a_set_is_evaluated_only_with_its_own_subspace(trained):
    (trained.folder / "tshirt-subspace.safetensors").write_bytes(
        (trained.folder / "vest-subspace.safetensors").read_bytes()
    )
    try:
        with pytest.raises(ValueError, match=r"vest\.npz is of garment 'vest', the subspace of 'tshirt'"):
            subspace_rows(SubspaceEvaluation(("tshirt",), trained.folder, trained.folder / "vest.npz"))
    finally:
        (trained.folder / "tshirt-subspace.safetensors").unlink()


def test_names_that_ship_and_shipping_are_refused_for_ones_own(tmp_path):
    shirt = Garment.load("tshirt")
    write_mesh(tmp_path / "tshirt.obj", Mesh(shirt.vertices.numpy(), shirt.faces.numpy()))
    with pytest.raises(ValueError, match="a garment 'tshirt' ships; give your own another name"):
        make_dataset(DatasetConfig(garment=str(tmp_path / "tshirt.obj"), out=tmp_path / "out"))
    (tmp_path / "tshirt.obj").rename(tmp_path / "vest.obj")
    with pytest.raises(ValueError, match="is your own: --ship is for those of the package"):
        make_dataset(DatasetConfig(garment=str(tmp_path / "vest.obj"), out=tmp_path / "out", ship=True))
    assert not (tmp_path / "out").exists()


def test_half_a_garment_in_a_file_is_refused(trained):
    data = CanonicalSet.load(trained.folder / "vest.npz")
    some = {key: tensor for key, tensor in data.garment.tensors().items() if not key.endswith("faces")}
    with pytest.raises(ValueError, match=r"garment 'vest' without garment\.faces; make it again"):
        Garment.from_tensors("vest", some)
    assert Garment.from_tensors("vest", {}) is None
    assert Subspace.load(trained.folder / "vest-subspace.safetensors").garment.faces.equal(data.garment.faces)
