"""`workbench export`: a dressed or a simulated sequence (.npz) -> .glb, .npz, OBJ, PLY or PC2; networks -> ONNX."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
import tyro

from workbench.body.model import Body
from workbench.collisions.posed_corrective import PosedCorrective
from workbench.collisions.sequences import SimulatedSequence
from workbench.collisions.tryon import load_tryon
from workbench.collisions.tryon_onnx import write_onnx
from workbench.formats.gltf import dressed_meshes, write_glb
from workbench.formats.mesh_sequence import (
    DressedSequence,
    Mesh,
    MeshSequence,
    read_dressed_sequence,
    write_dressed_sequence,
    write_mesh,
    write_mesh_folder,
    write_mesh_sequence,
)
from workbench.garments import Garment, shipped_garments
from workbench.npz import read_npz

Format = Literal["glb", "npz", "obj", "ply", "pc2"]
FORMATS: tuple[Format, ...] = ("glb", "npz", "obj", "ply", "pc2")


@dataclass(frozen=True)
class ExportConfig:
    """Write a body and its garment, moving, for other programs."""

    # A dressed sequence (body_vertices, garment_vertices, ...) or a simulated one (rotations, garment, ...), .npz; or
    # `body`, or the name of a garment that ships: as one mesh, in rest pose, to fit garments of your own to.
    sequence: tyro.conf.Positional[Path]
    # A .glb or .npz file; for obj, ply and pc2 a folder; for `body` and garments an .obj or .ply file.
    out: Path
    # Taken from the suffix of `out` when absent.
    format: Format | None = None
    # Keep every n-th frame.
    every: int = 1
    # Write the networks of the garment named in place of SEQUENCE to the folder `out`, as ONNX.
    onnx: bool = False
    # The folder of those networks (`workbench train`); those that ship when absent.
    networks: Path | None = None


def run(config: ExportConfig) -> list[Path]:
    """Convert; returns the files or folders written.

    Raises ValueError for an unknown format or a file that holds no sequence, FileNotFoundError.
    """
    if config.onnx:
        tryon = load_tryon(str(config.sequence), config.networks)
        corrective = tryon.corrective if isinstance(tryon.corrective, PosedCorrective) else None
        return write_onnx(config.out, tryon.regressor, tryon.subspace, corrective)
    still = still_mesh(config.sequence)
    if still is not None:
        write_mesh(config.out, still)
        return [config.out]
    kind = config.format or _format_of(config.out)
    if config.every < 1:
        raise ValueError(f"--every {config.every} keeps no frame: give 1 or more")
    dressed = read_any(config.sequence)
    dressed = DressedSequence(_thinned(dressed.body, config.every), _thinned(dressed.garment, config.every))
    if kind == "glb":
        write_glb(config.out, dressed_meshes(dressed.body, dressed.garment))
        return [config.out]
    if kind == "npz":
        write_dressed_sequence(config.out, dressed)
        return [config.out]
    written = []
    for mesh in (dressed.body, dressed.garment):
        target = config.out / (f"{mesh.name}.pc2" if kind == "pc2" else mesh.name)
        if kind == "pc2":
            write_mesh_sequence(target, mesh)
        else:
            write_mesh_folder(target, mesh, f".{kind}")
        written.append(target)
    return written


def still_mesh(source: Path) -> Mesh | None:
    """The canonical body or a garment that ships, where that is what the word names and no such file is there."""
    if source.exists():
        return None
    if str(source) == "body":
        body = Body.default()
        return Mesh(body.template.numpy(), body.faces.numpy())
    if str(source) in shipped_garments():
        garment = Garment.load(str(source))
        return Mesh(garment.vertices.numpy(), garment.faces.numpy())
    return None


def read_any(path: Path) -> DressedSequence:
    """A dressed sequence as it is, a simulated one with its body posed."""
    arrays = read_npz(path, "a dressed or simulated sequence")
    if "body_vertices" in arrays:
        return read_dressed_sequence(path)
    sequence = SimulatedSequence.load(path)
    body = Body.default()
    with torch.no_grad():
        posed = [
            body.vertices(rotations, sequence.betas, translation)
            for rotations, translation in zip(sequence.rotations, sequence.translation, strict=True)
        ]
    return DressedSequence(
        MeshSequence(torch.stack(posed).numpy(), body.faces.numpy(), sequence.fps, "body"),
        MeshSequence(sequence.garment.numpy(), sequence.faces.numpy(), sequence.fps, "garment"),
    )


def _format_of(out: Path) -> Format:
    for kind in FORMATS[:2]:
        if out.suffix.lower() == f".{kind}":
            return kind
    raise ValueError(f"cannot tell the format from {out}: end it in .glb or .npz, or add --format obj, ply or pc2")


def _thinned(sequence: MeshSequence, every: int) -> MeshSequence:
    return replace(sequence, vertices=sequence.vertices[::every], fps=sequence.fps / every)
