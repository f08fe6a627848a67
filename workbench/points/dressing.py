"""The run time of Sec. 3.3: one outfit on any pose.  theta (T,J,3,3), beta -> clothed points (T,N,3) in the world."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.motion import Motion
from workbench.points.clothed_points import ClothedPoints, PointModel, clothed
from workbench.points.fast_decoder import FastDecoder, OutfitShare
from workbench.points.lattice import Lattice
from workbench.points.scans import ScanFrame
from workbench.points.shape_decoder import CanonicalClothes, read_features
from workbench.points.training import Precision, autocast
from workbench.points.uv_position_map import (
    QUERY_SIZE,
    PosedBodies,
    SurfaceQueries,
    atlas_of,
    pelvis_frame,
    posed_bodies,
    posed_queries,
)

TOLERANCE = 1e-4  # metres; ours: half of what the published way and ours may differ by
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


class Dresser:
    """A trained model bound to one outfit and to the places that are asked for: what does not change is done once."""

    def __init__(
        self,
        model: PointModel,
        geometry: Float[Tensor, "1 d h w"],
        body: Body,
        *,
        queries: SurfaceQueries | None = None,
        query_size: int = QUERY_SIZE,
        precision: Precision = "float32",
        tolerance: float = TOLERANCE,
    ):
        """geometry: smoothed features (`model.geometry(outfit)`, or `scan_fitting.features_of`); queries: where clothes
        are asked for, each of which is decoded (default: every pixel of the query map that shows the body, of which
        about a third is decoded and the rest lies between them to within `tolerance`, metres); precision: bfloat16
        takes two thirds of the time, but moves points by some hundredths of their displacement: for previews."""
        self.model, self.body = model.eval(), body
        self.precision: Precision = precision
        self.tolerance = tolerance
        self._atlas = atlas_of(body, model.config.input_size)
        self._decoder = FastDecoder(model.decoder, model.config.encoder.features, DTYPES[precision])
        self._lattice = Lattice.of(atlas_of(body, query_size)) if queries is None and tolerance > 0 else None
        self.queries = atlas_of(body, query_size).queries if queries is None else queries
        self._share = self._share_at(self.queries.u, geometry)
        if self._lattice is not None:
            self._corners_share = self._share_at(self._lattice.u, geometry)

    @torch.no_grad()
    def _share_at(self, u: Float[Tensor, "N 2"], geometry: Float[Tensor, "1 d h w"]) -> OutfitShare:
        return self._decoder.share(u, read_features(geometry, u)[0])

    @torch.no_grad()
    def __call__(self, bodies: PosedBodies) -> ClothedPoints:
        """Clothes on bodies in the pelvis frame, frame by frame."""
        image = self._atlas.map_of(bodies.seen)
        with autocast(self.precision, image.device):
            pose = self.model.encoder(image).float()
        frames = [self._decode(P[None]) for P in pose]
        canonical = CanonicalClothes(
            torch.stack([frame.displacement for frame in frames]), torch.stack([frame.normal for frame in frames])
        )
        return clothed(posed_queries(self.queries, bodies), canonical)

    def _decode(self, pose: Float[Tensor, "1 c H W"]) -> CanonicalClothes:
        if self._lattice is None:
            return self._decoder(read_features(pose, self.queries.u)[0], self._share)
        at_corners = self._decoder(read_features(pose, self._lattice.u)[0], self._corners_share)
        canonical = self._lattice.clothes(at_corners)
        doubtful = self._lattice.doubtful(at_corners.displacement, self.tolerance).nonzero()[:, 0]
        exact = self._decoder(read_features(pose, self.queries.u[doubtful])[0], self._share.at(doubtful))
        canonical.displacement[doubtful] = exact.displacement
        canonical.normal[doubtful] = exact.normal
        return canonical

    def animate(self, motion: Motion, betas: Float[Tensor, " K"]) -> Iterator[ScanFrame]:
        """Points and normals in the world, one frame of the motion after another."""
        for rotations, translation in zip(motion.rotations, motion.translation, strict=True):
            cloud = self(posed_bodies(self.body, rotations[None], betas))
            frame = pelvis_frame(self.body, rotations, betas, translation)
            yield ScanFrame(frame.to_world(cloud.points[0]), cloud.normals[0] @ frame.rotation.mT)
