"""Trained models of clothes on disk.  model, names of its outfits, how it was trained -> safetensors <-> the same."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from workbench.body.model import Body
from workbench.learning.network_file import read_network, write_network
from workbench.points.clothed_points import PointModel, PointModelConfig
from workbench.points.geometry_features import GeometryFeaturesConfig
from workbench.points.patches import PatchModel, PatchModelConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.uv_position_map import atlas_fingerprint

KIND, PATCHES_KIND = "points-2", "patches-1"  # of the files
REMEDY = "train or fetch it again"


@dataclass(frozen=True, eq=False)
class TrainedPoints:
    """POP after training: the outfits that its G are of, in order, and the story of the run (config, curves)."""

    model: PointModel
    outfits: tuple[str, ...]
    story: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path, body: Body) -> None:
        """Written whole or not at all; the body is the one it was trained on."""
        _write(self.model, asdict(self.model.config), self.outfits, self.story, KIND, Path(path), body)

    @staticmethod
    def load(path: str | Path, body: Body) -> "TrainedPoints":
        """Raises FileNotFoundError, or ValueError for a damaged or foreign file, or one trained for another body."""
        stored = _read(Path(path), KIND, body)
        config = PointModelConfig(
            encoder=PoseEncoderConfig(**stored.config["encoder"]),
            geometry=GeometryFeaturesConfig(**stored.config["geometry"]),
            decoder=ShapeDecoderConfig(**stored.config["decoder"]),
            input_size=stored.config["input_size"],
        )
        model = PointModel(len(stored.outfits), config, generator=torch.Generator())
        model.load_state_dict(stored.tensors)
        return TrainedPoints(model.eval(), stored.outfits, stored.story)

    def number_of(self, outfit: str) -> int:
        """Which G an outfit has.  Raises ValueError naming those there are."""
        if outfit not in self.outfits:
            raise ValueError(f"the model knows no outfit {outfit!r}; it was trained on {', '.join(self.outfits)}")
        return self.outfits.index(outfit)


@dataclass(frozen=True, eq=False)
class TrainedPatches:
    """The patches of one outfit after training."""

    model: PatchModel
    outfits: tuple[str, ...]
    story: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: str | Path, body: Body) -> None:
        """As `TrainedPoints.save`."""
        _write(self.model, asdict(self.model.config), self.outfits, self.story, PATCHES_KIND, Path(path), body)

    @staticmethod
    def load(path: str | Path, body: Body) -> "TrainedPatches":
        """As `TrainedPoints.load`."""
        stored = _read(Path(path), PATCHES_KIND, body)
        config = PatchModelConfig(
            encoder=PoseEncoderConfig(**stored.config["encoder"]),
            decoder=ShapeDecoderConfig(**stored.config["decoder"]),
            size=stored.config["size"],
            side=stored.config["side"],
        )
        model = PatchModel(config, generator=torch.Generator())
        model.load_state_dict(stored.tensors)
        return TrainedPatches(model.eval(), stored.outfits, stored.story)


@dataclass(frozen=True)
class _Stored:
    tensors: dict[str, torch.Tensor]
    config: dict[str, Any]
    outfits: tuple[str, ...]
    story: dict[str, Any]


def _write(
    model: nn.Module,
    config: dict[str, Any],
    outfits: tuple[str, ...],
    story: Mapping[str, Any],
    kind: str,
    path: Path,
    body: Body,
) -> None:
    metadata = {
        "kind": kind,
        "made_for": atlas_fingerprint(body),
        "config": json.dumps(config),
        "outfits": json.dumps(outfits),
        "story": json.dumps(story),
    }
    write_network(model, path, metadata)


def _read(path: Path, kind: str, body: Body) -> _Stored:
    file = read_network(path, REMEDY)
    got = file.metadata.get("kind")
    if got != kind:
        raise ValueError(f"{path} is of kind {got!r}, expected {kind!r}; {REMEDY}")
    made_for, fingerprint = file.metadata.get("made_for"), atlas_fingerprint(body)
    if made_for != fingerprint:
        raise ValueError(
            f"points model {path} was trained for another body ({made_for}, {body.name!r} is {fingerprint}); "
            "train it for this body"
        )
    return _Stored(
        tensors=file.tensors,
        config=json.loads(file.metadata["config"]),
        outfits=tuple(json.loads(file.metadata["outfits"])),
        story=json.loads(file.metadata["story"]),
    )
