"""Eq. 2: the point model.  position map I, outfit, u_i, p_i, T_i -> clothed points x_i (N,3), normals n(x_i) (N,3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from workbench.points.geometry_features import GeometryFeatures, GeometryFeaturesConfig
from workbench.points.pose_encoder import PoseEncoder, PoseEncoderConfig
from workbench.points.shape_decoder import CanonicalClothes, ShapeDecoder, ShapeDecoderConfig, decoder_inputs
from workbench.points.uv_position_map import INPUT_SIZE, PosedQueries


@dataclass(frozen=True)
class PointModelConfig:
    """All networks; the paper's by default (11.3 M parameters and 1 M an outfit)."""

    encoder: PoseEncoderConfig = PoseEncoderConfig()
    geometry: GeometryFeaturesConfig = GeometryFeaturesConfig()
    decoder: ShapeDecoderConfig = ShapeDecoderConfig()
    input_size: int = INPUT_SIZE  # pixels a side of the position map that the encoder reads

    def __post_init__(self) -> None:
        total = self.encoder.features + self.geometry.features
        if self.decoder.features != total:
            raise ValueError(
                f"the decoder reads {self.decoder.features} features, but the encoder and G give "
                f"{self.encoder.features} + {self.geometry.features}; set decoder.features to {total}"
            )


@dataclass(frozen=True)
class ClothedPoints:
    """A clothed body as points, in the frame of the bodies it was asked for (the pelvis frame), metres."""

    points: Float[Tensor, "B N 3"]  # x_i
    normals: Float[Tensor, "B N 3"]  # n(x_i), unit
    displacement: Float[Tensor, "B N 3"]  # r_i, canonical


def posed_points(
    T: Float[Tensor, "B N 3 3"], r: Float[Tensor, "B N 3"], p: Float[Tensor, "B N 3"]
) -> Float[Tensor, "B N 3"]:
    """x_i = T_i r_i + p_i      (Eq. 2)"""
    return (T @ r[..., None])[..., 0] + p


def posed_normals(T: Float[Tensor, "B N 3 3"], n: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
    """n(x_i): the canonical normal turned by T_i, of unit length."""
    return nn.functional.normalize((T @ n[..., None])[..., 0], dim=-1, eps=1e-12)


def clothed(posed: PosedQueries, canonical: CanonicalClothes) -> ClothedPoints:
    """Canonical clothes on posed bodies."""
    return ClothedPoints(
        points=posed_points(posed.transforms, canonical.displacement, posed.points),
        normals=posed_normals(posed.transforms, canonical.normal),
        displacement=canonical.displacement,
    )


class PointModel(nn.Module):
    """POP: pose encoder, geometry features of C outfits, shape decoder shared by all of them."""

    def __init__(
        self, outfits: int, config: PointModelConfig = PointModelConfig(), *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.config = config
        self.encoder = PoseEncoder(config.encoder, generator=generator)
        self.geometry = GeometryFeatures(outfits, config.geometry, generator=generator)
        self.decoder = ShapeDecoder(config.decoder, generator=generator)

    def penalised(self) -> Float[Tensor, "C c H W"]:
        """G of every outfit, for Eq. 6."""
        return self.geometry.tensors

    def forward(
        self, position_map: Float[Tensor, "B i H W"], outfit: Int[Tensor, " B"], posed: PosedQueries
    ) -> ClothedPoints:
        """The clothes of each frame's outfit at the queries."""
        return self.dress(position_map, self.geometry(outfit), posed)

    def dress(
        self, position_map: Float[Tensor, "B i H W"], geometry: Float[Tensor, "B d h w"], posed: PosedQueries
    ) -> ClothedPoints:
        """The same with smoothed geometry features that are given (of a scan that was fitted, Eq. 7)."""
        pose = self.encoder(position_map)
        return clothed(posed, self.decode(posed.u, pose, geometry))

    def decode(
        self, u: Float[Tensor, "N 2"], pose: Float[Tensor, "B c H W"], geometry: Float[Tensor, "B d h w"]
    ) -> CanonicalClothes:
        """The canonical clothes at u, in single precision whatever the networks' is."""
        canonical = self.decoder(decoder_inputs(u, pose.float(), geometry.float()))
        return CanonicalClothes(canonical.displacement.float(), canonical.normal.float())
