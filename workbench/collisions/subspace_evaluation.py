"""`workbench evaluate subspace`: Fig. 4 and what the latent space holds.  subspace, unseen sequences -> rows."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.canonical_set import CanonicalSet
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import penetration
from workbench.collisions.projection import Projector
from workbench.collisions.sequences import tests_of
from workbench.collisions.subspace import SHIPPED, Subspace
from workbench.evaluation_table import Row, at_most, told, within
from workbench.garments import Garment
from workbench.geometry.laplacian import apply_laplacian, umbrella_laplacian
from workbench.geometry.strain import rest_triangles

MILLI, PERCENT = 1e3, 100.0
AT_ONCE = 128  # garments decoded at once


@dataclass(frozen=True)
class SubspaceEvaluation:
    """Reconstruction of unseen frames, collisions of decoded garments, and the curves of the training."""

    garments: tuple[str, ...] = ()  # by default all whose subspace ships
    networks: Path | None = None  # a folder of subspaces; those that ship when absent
    data: Path | None = None  # the training set of one garment (`python -m assets_gen dataset`); what ships when absent
    sequences: Path | None = None  # a folder with simulated test sequences, of the same command; what ships when absent
    samples: int = 1000  # garments decoded from N(0, I)
    test_sequences: int = 6  # how many of the shipped test sequences are projected and reconstructed
    seed: int = 5


def rows(config: SubspaceEvaluation) -> list[Row]:
    """Everything, in one run."""
    table: list[Row] = []
    for name in config.garments or trained_garments(config.networks or SHIPPED):
        table += garment_rows(name, config)
    return table


def trained_garments(folder: Path) -> tuple[str, ...]:
    """Garments with a subspace in the folder.  Raises ValueError when there are none."""
    names = tuple(sorted(path.name.rpartition("-")[0] for path in folder.glob("*-subspace.safetensors")))
    if not names:
        raise ValueError(f"there is no subspace in {folder}; train one with `workbench train subspace`")
    return names


@torch.no_grad()
def garment_rows(name: str, config: SubspaceEvaluation) -> list[Row]:
    """One garment: unseen frames there and back, garments drawn from N(0, I), exact winding numbers."""
    subspace = Subspace.load((config.networks or SHIPPED) / f"{name}-subspace.safetensors")
    data = CanonicalSet.load(config.data) if config.data else CanonicalSet.shipped(name)
    if data.garment_name != name:
        raise ValueError(
            f"{config.data} is of garment {data.garment_name!r}, the subspace of {name!r}; name one garment"
        )
    body, sdf = Body.default(), GridSDF.default()
    laplacian = umbrella_laplacian(data.garment.faces, len(data.mean))
    table = [told(f"{name}: compact training set, RMS loss", MILLI * data.error, "mm")]
    for split in ("train", "validation", "test"):
        X = (
            unseen_garments(subspace.garment, config.test_sequences, config.sequences)
            if split == "test"
            else data.garments(_thinned(data.kept(split), 1500))
        )
        decoded = _there_and_back(subspace, X)
        error = MILLI * float((decoded - X).norm(dim=-1).mean())
        label = f"{name}: {split} frames, canonical reconstruction error, mean"
        table.append(at_most(label, error, "mm", 4.0) if split == "test" else told(label, error, "mm"))
        table.append(told(f"{name}: {split} frames, reconstructed, inside", _inside(body, decoded), "%"))
        if split == "test":
            mean_only = MILLI * float((data.mean - X).norm(dim=-1).mean())
            table.append(told(f"{name}: the same error of the mean garment", mean_only, "mm"))
            ratio = float(wrinkles(laplacian, decoded) / wrinkles(laplacian, X))
            table.append(within(f"{name}: Laplacian energy, reconstruction / simulation", ratio, "", 0.7, 1.2))
    generator = torch.Generator().manual_seed(config.seed)
    imagined = torch.cat(
        [subspace.sample(len(part), generator) for part in torch.arange(config.samples).split(AT_ONCE)]
    )
    table.append(at_most(f"{name}: {config.samples} garments from N(0, I), inside", _inside(body, imagined), "%", 0.02))
    gap = MILLI * float(sdf(data.garments(_thinned(data.kept("train"), 500))).mean())
    table.append(told(f"{name}: mean gap to the body, simulation", gap, "mm"))
    table.append(
        told(f"{name}: mean gap to the body, garments from N(0, I)", MILLI * float(sdf(imagined).mean()), "mm")
    )
    return table + curve_rows(name, subspace)


def unseen_garments(
    garment: Garment, sequences: int, folder: Path | None = None, every: int = 4
) -> Float[Tensor, "B N 3"]:
    """The test sequences that ship (or of a folder), projected here and now: canonical garments that no training and no
    basis saw."""
    rest = rest_triangles(garment.rest_vertices, garment.faces)
    model = GarmentModel(Body.default(), GridFields.default())
    projector = Projector(model, GridSDF.default(), rest, garment.vertices)
    found = []
    for s in tests_of(garment.name, folder)[:sequences]:
        state = model.state(s.rotations, s.betas, s.translation)
        X = projector.unskin(s.garment, state).canonical
        found.append(X[s.valid][::every])
    if not found:
        raise ValueError(
            f"there is no test sequence of garment {garment.name!r} in {folder or 'what ships'}; make some with "
            "`python -m assets_gen dataset` and pass its folder with --sequences"
        )
    return torch.cat(found)


def curve_rows(name: str, subspace: Subspace) -> list[Row]:
    """Fig. 4: collisions on unseen sequences during the training, as kept with the checkpoint."""
    curves = subspace.story.get("curves", [])
    picked = [curves[i] for i in sorted({0, len(curves) // 4, len(curves) // 2, len(curves) - 1})] if curves else []
    return [
        told(f"{name}: after {entry['step']} steps, unseen frames inside", entry["validation inside, %"], "%")
        for entry in picked
    ]


def wrinkles(laplacian: Float[Tensor, "N N"], X: Float[Tensor, "B N 3"]) -> Float[Tensor, ""]:
    """Mean length of the umbrella Laplacian: how much folds there are, metres."""
    return apply_laplacian(laplacian, X).norm(dim=-1).mean()


def _there_and_back(subspace: Subspace, X: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
    return torch.cat([subspace.decode(subspace.encode(part)) for part in X.split(AT_ONCE)])


def _inside(body: Body, X: Float[Tensor, "B N 3"]) -> float:
    """Share of vertices inside the constant body, percent, by exact winding number."""
    return PERCENT * penetration(body.template[None], body.faces, X).share


def _thinned(frames: Float[Tensor, "M R"], most: int) -> Float[Tensor, "_ R"]:
    return frames[:: max(1, -(-len(frames) // most))]
