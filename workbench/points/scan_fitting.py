"""Eq. 7: a scan nobody trained on -> its G.  scan Y (N,3) with its body -> G (1,64,H,W), all networks fixed.

The pose does not change during a fit, so P is computed once; only G moves, and a step decodes random pixels.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.geometry.chamfer import NearestPoint, match
from workbench.geometry.closest_point import ClosestPoint
from workbench.learning.fit import FitConfig, FitResult, fit
from workbench.npz import read_npz
from workbench.points.clothed_points import PointModel, clothed
from workbench.points.losses import (
    LOOSE,
    LossTerms,
    LossWeights,
    displacement_loss,
    distance_loss,
    geometry_loss,
    normal_loss,
)
from workbench.points.scans import ScanFrame
from workbench.points.training import Precision, autocast, quick_precision
from workbench.points.uv_position_map import (
    QUERY_SIZE,
    PosedBodies,
    SurfaceQueries,
    atlas_of,
    posed_queries,
)
from workbench.points.worn_scan import require_aligned
from workbench.store import atomic_write

FORMAT = "fitted-outfit-2"


@dataclass(frozen=True)
class ScanFitConfig:
    """How one scan is fitted."""

    fit: FitConfig = FitConfig(
        steps=2200, learning_rate=1.2e-2, last_rate=1e-3, warmup=5, clip_norm=1e9, checkpoint_every=10**9
    )  # ours: facts.md 2 has 401 steps of 5e-4; larger and falling rates reach the same loss sooner
    weights: LossWeights = LOOSE
    queries: int = 6000  # pixels a step
    scan_points: int = 12000  # of the scan a step
    precision: Precision = field(default_factory=quick_precision)  # of the decoder, while G moves
    query_size: int = QUERY_SIZE
    seed: int = 0


@dataclass(frozen=True, eq=False)
class FittedOutfit:
    """What a scan wears: G, for these networks and no others; Eq. 3 over all of the scan before and after."""

    name: str
    G: Float[Tensor, "1 c H W"]
    betas: Float[Tensor, " K"]  # of who wears it
    networks: str  # `networks_fingerprint`
    loss_before: float
    loss_after: float

    def save(self, path: str | Path) -> None:
        """Own npz; G as float16."""
        with atomic_write(path) as part:
            np.savez_compressed(
                part,
                format=np.array(FORMAT),
                name=np.array(self.name),
                G=self.G.numpy().astype(np.float16),
                betas=self.betas.numpy(),
                networks=np.array(self.networks),
                losses=np.array([self.loss_before, self.loss_after]),
            )

    @staticmethod
    def load(path: str | Path) -> "FittedOutfit":
        """Raises FileNotFoundError, or ValueError for another file."""
        arrays = read_npz(path, "a fitted outfit", required=("format", "name", "G", "betas", "networks", "losses"))
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"{path} has format {str(arrays['format'])!r}; expected {FORMAT!r}")
        before, after = (float(loss) for loss in arrays["losses"])
        return FittedOutfit(
            name=str(arrays["name"]),
            G=torch.from_numpy(arrays["G"]).float(),
            betas=torch.from_numpy(arrays["betas"]).float(),
            networks=str(arrays["networks"]),
            loss_before=before,
            loss_after=after,
        )


def fit_scan(
    model: PointModel,
    body: Body,
    scan: ScanFrame,
    bodies: PosedBodies,
    config: ScanFitConfig = ScanFitConfig(),
    *,
    betas: Float[Tensor, " K"],
    name: str = "scan",
    watch: Callable[[int, float], None] | None = None,
) -> tuple[FittedOutfit, FitResult]:
    """argmin_G L_total(Y)      (Eq. 7), from the mean of the trained G or that of an outfit, whichever is nearest.

    scan, bodies, betas: one frame in the pelvis frame; the model is in evaluation mode and is not changed.
    Raises ValueError where the body does not lie in the scan.
    """
    require_aligned(scan, bodies)
    places = atlas_of(body, config.query_size).queries
    image = atlas_of(body, model.config.input_size).map_of(bodies.seen)
    model.eval().requires_grad_(False)
    try:
        with torch.no_grad():
            pose = model.encoder(image)
        in_scan = NearestPoint(scan.points.numpy())

        def terms_at(
            G: Float[Tensor, "1 c H W"],
            asked: SurfaceQueries,
            rows: Int[Tensor, " K"] | None = None,
            precision: Precision = "float32",
        ) -> LossTerms:
            posed = posed_queries(asked, bodies)
            with autocast(precision, image.device):
                canonical = model.decode(asked.u, pose, model.geometry.smooth(G))
            cloud = clothed(posed, canonical)
            x, n_x = cloud.points[0], cloud.normals[0]
            matches = match(x, scan.points, nearest_in_y=in_scan, rows=rows)
            return LossTerms(
                distance=distance_loss(x, scan.points, matches),
                normal=normal_loss(n_x, scan.normals, matches),
                displacement=displacement_loss(cloud.displacement),
                geometry=geometry_loss(G),
            )

        def drawn(generator: torch.Generator) -> tuple[SurfaceQueries, Int[Tensor, " K"]]:
            asked = places.subset(torch.randperm(len(places), generator=generator)[: config.queries])
            return asked, torch.randperm(len(scan.points), generator=generator)[: config.scan_points]

        def loss_of(step: int, generator: torch.Generator) -> Tensor:
            return terms_at(G, *drawn(generator), config.precision).total(config.weights)

        @torch.no_grad()
        def nearest_start() -> Float[Tensor, "1 c H W"]:
            starts = torch.cat([model.geometry.mean()[None], model.geometry.tensors.detach()])
            same = drawn(torch.Generator().manual_seed(config.seed))
            losses = [terms_at(start[None], *same).total(config.weights).item() for start in starts]
            return starts[losses.index(min(losses))][None].clone()

        @torch.no_grad()
        def whole_loss() -> float:
            return terms_at(G, places).total(config.weights).item()

        G = nearest_start().requires_grad_()
        before = whole_loss()
        generator = torch.Generator().manual_seed(config.seed)
        result = fit([G], loss_of, config.fit, generator=generator, label=f"fit {name}", watch=watch)
        fitted = FittedOutfit(name, G.detach(), betas, networks_fingerprint(model), before, whole_loss())
        return fitted, result
    finally:
        model.requires_grad_(True)


def networks_fingerprint(model: PointModel) -> str:
    """A hash of all that is shared by outfits: G means nothing to other networks."""
    digest = hashlib.sha256()
    for key, tensor in sorted(model.state_dict().items()):
        if key != "geometry.stored":
            digest.update(key.encode() + tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def features_of(model: PointModel, fitted: FittedOutfit) -> Float[Tensor, "1 c H W"]:
    """What `PointModel.dress` reads of a fitted outfit.  ValueError for one that was fitted with other networks."""
    own = networks_fingerprint(model)
    if fitted.networks != own:
        raise ValueError(
            f"outfit {fitted.name!r} was fitted with other networks ({fitted.networks}; these are {own}): "
            "give the model it was fitted with (--model), or fit its scan again"
        )
    with torch.no_grad():
        return model.geometry.smooth(fitted.G)


def lbs_of_scan(scan: ScanFrame, body: Body, worn: PosedBodies, posed: PosedBodies) -> ScanFrame:
    """Fig. 5's baseline: every scan point is tied to its closest body point and moves rigidly with it.

    worn: the body in the scan; posed: the same body in another pose (one frame each).
    """
    surface = ClosestPoint(worn.vertices[0].numpy(), body.faces.numpy()).query(scan.points.numpy())
    tied = SurfaceQueries(
        u=torch.zeros(len(scan.points), 2),
        corners=body.faces[torch.from_numpy(surface.face)],
        barycentric=torch.from_numpy(surface.barycentric),
    )
    before, after = posed_queries(tied, worn), posed_queries(tied, posed)
    turn = after.transforms[0] @ torch.linalg.inv(before.transforms[0])
    points = (turn @ (scan.points - before.points[0])[..., None])[..., 0] + after.points[0]
    normals = torch.nn.functional.normalize((turn @ scan.normals[..., None])[..., 0], dim=-1)
    return ScanFrame(points, normals)
