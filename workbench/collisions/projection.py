"""Eq. 9-12: simulated garments to canonical space.  M_G (T,N,3), beta, theta -> X (T,N,3), M_G(X, beta, theta) = M_G.

Two steps.  Fixed-point unskinning, X <- X + A(X)^-1 (M_G - M_G(X)), starts at the frame before and solves the data term
almost everywhere.  What it leaves (vertices where space folds, or inside the body) is mended by minimising Eq. 9.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.collisions.body_sdf import BodySDF
from workbench.collisions.garment_model import BodyState, GarmentModel
from workbench.geometry.strain import RestTriangles, deformation_gradient, green_strain

POINTS_AT_ONCE = 4096  # of the Newton steps: bounds the memory of their Jacobians

Progress = Callable[[int], None]
Guess = Callable[[Tensor, Tensor], Tensor]  # X (T,N,3), which are wrong (T,N) -> another start for those


@dataclass(frozen=True)
class ProjectionConfig:
    """The paper leaves all of these open; ours, measured by `workbench evaluate projection`."""

    fixed_point_steps: int = 6  # facts: tenfold contraction a step
    newton_steps: int = 12  # from each start, for the few vertices that the fixed point circles around
    carry_steps: int = 20  # averagings by which a bad vertex learns where its neighbours went
    newton_reach: float = 0.02  # metres a step at most
    tolerance: float = 2e-5  # metres of re-posing error at which a vertex rests
    newton_error: float = 1e-4  # metres; vertices above it are started again
    mended_error: float = 1e-3  # metres; vertices above it go to the optimisation
    strain_weight: float = 1e-7  # omega_1 of Eq. 9: a doubled edge weighs as much as 0.5 mm
    collision_weight: float = 4e-3  # omega_2 of Eq. 9: worth up to 2 mm of re-posing error
    clearance: float = 1e-3  # epsilon of Eq. 12, metres
    mend_rings: int = 1  # vertices around the bad ones that may move along
    mend_steps: int = 30
    mend_rate: float = 2e-4  # metres a step at the start
    frames_at_once: int = 32


@dataclass(frozen=True)
class Projection:
    """Canonical garments and how well they return."""

    canonical: Float[Tensor, "T N 3"]
    error: Float[Tensor, "T N"]  # |M_G - M_G(X)|, metres
    mended: Bool[Tensor, "T N"]  # where Eq. 9's optimisation had its say


@dataclass(frozen=True)
class Energy:
    """The three terms of Eq. 9, summed over a garment."""

    rec: Float[Tensor, ""]
    strain: Float[Tensor, ""]
    collision: Float[Tensor, ""]

    def total(self, config: ProjectionConfig) -> Float[Tensor, ""]:
        """Eq. 9"""
        return self.rec + config.strain_weight * self.strain + config.collision_weight * self.collision


def reconstruction_energy(target: Float[Tensor, "*B N 3"], posed: Float[Tensor, "*B N 3"]) -> Float[Tensor, ""]:
    """|| M_G - M_G(X, beta, theta) ||^2      (Eq. 10), square metres"""
    return (target - posed).square().sum()


def strain_energy(unposed: Float[Tensor, "*B N 3"], rest: RestTriangles) -> Float[Tensor, ""]:
    """|| 1/2 (F(T_G)^T F(T_G) - I) ||^2      (Eq. 11)"""
    return green_strain(deformation_gradient(unposed, rest)).square().sum()


def collision_energy(signed_distance: Float[Tensor, "*B N"], clearance: float) -> Float[Tensor, ""]:
    """max(epsilon - SDF(X), 0)      (Eq. 12), metres"""
    return (clearance - signed_distance).clamp_min(0.0).sum()


@dataclass(frozen=True)
class Projector:
    """Projects sequences of one garment: `Projector(model, sdf, rest, template).project(garment, state)`."""

    model: GarmentModel
    sdf: BodySDF
    rest: RestTriangles  # the garment's material, for Eq. 11
    template: Float[Tensor, "N 3"]  # start of the first frame
    config: ProjectionConfig = ProjectionConfig()

    def project(
        self,
        garment: Float[Tensor, "T N 3"],
        state: BodyState,
        progress: Progress = lambda frames: None,
    ) -> Projection:
        """A simulated sequence with the body states that it was simulated on.

        Errors: ValueError when the vertex count is not the template's, frames differ, or positions are not finite.
        """
        self._check(garment, state)
        return self.mend(garment, state, self.unskin(garment, state, progress))

    @torch.no_grad()
    def unskin(
        self, garment: Float[Tensor, "T N 3"], state: BodyState, progress: Progress = lambda frames: None
    ) -> Projection:
        """Fixed-point unskinning alone, each frame from the one before (the first from the template)."""
        canonical, errors = torch.empty_like(garment), garment.new_empty(garment.shape[:-1])
        start = self.template
        for frame, target in enumerate(garment):
            canonical[frame], errors[frame] = fixed_point(self.model, target, state[frame], start, self.config)
            start = canonical[frame]
            progress(1)
        for guess in (_as_they_are, self._carried, self._template):
            self._retry(garment, state, canonical, errors, guess)
        return Projection(canonical, errors, torch.zeros_like(errors, dtype=torch.bool))

    def _retry(
        self,
        garment: Float[Tensor, "T N 3"],
        state: BodyState,
        canonical: Float[Tensor, "T N 3"],
        errors: Float[Tensor, "T N"],
        guess: Guess,
    ) -> None:
        """Newton steps from another start for the vertices that are still wrong; the better answer stays (in place)."""
        bad = errors > self.config.newton_error
        if not bool(bad.any()):
            return
        frames = bad.any(dim=1).nonzero()[:, 0]
        start = canonical.clone()
        start[frames] = guess(canonical[frames], bad[frames])
        frame, vertex = bad.nonzero(as_tuple=True)
        for part in _chunks(len(frame), POINTS_AT_ONCE):
            pair = (frame[part], vertex[part])
            X, error = levenberg_marquardt(self.model, garment[pair], state[frame[part]], start[pair], self.config)
            better = error < errors[pair]
            canonical[pair] = torch.where(better[:, None], X, canonical[pair])
            errors[pair] = torch.minimum(error, errors[pair])

    def _carried(self, canonical: Float[Tensor, "T N 3"], bad: Bool[Tensor, "T N"]) -> Float[Tensor, "T N 3"]:
        """Where the mesh around them would carry bad vertices: their neighbours' displacement from the template."""
        frame, vertex = bad.nonzero(as_tuple=True)
        table = neighbour_table(self.rest.faces, len(self.template))
        around = table[vertex]  # -1 where a vertex has fewer neighbours
        displacement, known = canonical - self.template, ~bad
        for _ in range(self.config.carry_steps):
            counts = (around >= 0) & known[frame[:, None], around]
            total = (displacement[frame[:, None], around] * counts[..., None]).sum(dim=1)
            weight = counts.sum(dim=1)
            reached = weight > 0
            pair = (frame[reached], vertex[reached])
            displacement[pair] = total[reached] / weight[reached, None]
            known[pair] = True
        return self.template + torch.where(known[..., None], displacement, 0.0)

    def _template(self, canonical: Float[Tensor, "T N 3"], bad: Bool[Tensor, "T N"]) -> Float[Tensor, "T N 3"]:
        return self.template.expand_as(canonical)

    def mend(self, garment: Float[Tensor, "T N 3"], state: BodyState, start: Projection) -> Projection:
        """Minimise Eq. 9 over the vertices that unskinning left wrong or inside the body, and their neighbours.

        A vertex takes its new place only with its whole patch, and a frame's energy never rises.
        """
        canonical, errors, mended = start.canonical.clone(), start.error.clone(), start.mended.clone()
        bad = self._needs_mending(canonical, errors)
        for frames in bad.any(dim=1).nonzero()[:, 0].split(self.config.frames_at_once):
            patch = self._patch(bad[frames])
            moved, error = self._minimise(garment[frames], state[frames], canonical[frames], patch)
            canonical[frames], errors[frames] = moved, torch.where(patch.free, error, errors[frames])
            mended[frames] = patch.free
        return replace(start, canonical=canonical, error=errors, mended=mended)

    @torch.no_grad()
    def energy(self, garment: Float[Tensor, "N 3"], state: BodyState, X: Float[Tensor, "N 3"]) -> Energy:
        """The terms of Eq. 9 for one frame, over the whole garment."""
        local = self.model.local_map(X, state)
        return Energy(
            reconstruction_energy(garment, local.posed(X)),
            strain_energy(local.unposed(X), self.rest),
            collision_energy(self.sdf(X), self.config.clearance),
        )

    @torch.no_grad()
    def _needs_mending(self, X: Float[Tensor, "T N 3"], error: Float[Tensor, "T N"]) -> Bool[Tensor, "T N"]:
        return (error > self.config.mended_error) | (self.sdf(X) < 0)

    def _patch(self, bad: Bool[Tensor, "T N"]) -> "_Patch":
        free = bad
        for _ in range(self.config.mend_rings):
            free = _dilated(free, self.rest.faces)
        held = _dilated(free, self.rest.faces)
        frame, vertex = held.nonzero(as_tuple=True)
        slot = torch.full(held.shape, -1, dtype=torch.long)
        slot[frame, vertex] = torch.arange(len(frame))
        corners = slot[:, self.rest.faces]
        inside = (corners >= 0).all(dim=-1) & free[:, self.rest.faces].any(dim=-1)
        which = inside.nonzero()[:, 1]
        triangles = RestTriangles(corners[inside], self.rest.inverse_edges[which], self.rest.area[which])
        return _Patch(free, frame, vertex, free[frame, vertex], triangles)

    def _minimise(
        self, garment: Float[Tensor, "T N 3"], state: BodyState, start: Float[Tensor, "T N 3"], patch: "_Patch"
    ) -> tuple[Float[Tensor, "T N 3"], Float[Tensor, "T N"]]:
        config = self.config
        target, first = garment[patch.frame, patch.vertex], start[patch.frame, patch.vertex]
        step = torch.zeros_like(first, requires_grad=True)
        optimiser = torch.optim.Adam([step], lr=config.mend_rate)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.mend_steps)
        free = patch.moves[:, None]

        def terms(X: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor, Tensor]:
            unposed, posed = self._posed_patch(X, state, patch.frame)
            strain = green_strain(deformation_gradient(unposed, patch.triangles)).square().sum(dim=(-1, -2))
            gap = (config.clearance - self.sdf(X)).clamp_min(0.0)
            return (target - posed).square().sum(dim=-1), strain, gap

        def frame_energy(rec: Tensor, strain: Tensor, gap: Tensor) -> Float[Tensor, "T"]:
            total = torch.zeros(len(garment), dtype=rec.dtype)
            total = total.index_add(0, patch.frame, rec + config.collision_weight * gap)
            return total.index_add(0, patch.frame[patch.triangles.faces[:, 0]], config.strain_weight * strain)

        with torch.no_grad():
            before = frame_energy(*terms(first))
        for _ in range(config.mend_steps):
            rec, strain, gap = terms(first + step * free)
            loss = rec.sum() + config.strain_weight * strain.sum() + config.collision_weight * gap.sum()  # Eq. 9
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            decay.step()
        with torch.no_grad():
            last = first + step * free
            after = frame_energy(*terms(last))
            X = torch.where((after < before)[patch.frame, None], last, first)
            _, posed = self._posed_patch(X, state, patch.frame)
            canonical = start.clone()
            canonical[patch.frame, patch.vertex] = X
            error = torch.zeros(garment.shape[:-1])
            error[patch.frame, patch.vertex] = (target - posed).norm(dim=-1)
        return canonical, error

    def _posed_patch(
        self, X: Float[Tensor, "P 3"], state: BodyState, frame: Int[Tensor, "P"]
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """T_G and M_G of loose points, each in its own frame."""
        local = self.model.local_map(X[:, None], state[frame])
        return local.unposed(X[:, None])[:, 0], local.posed(X[:, None])[:, 0]

    def _check(self, garment: Tensor, state: BodyState) -> None:
        if garment.shape[-2] != len(self.template):
            raise ValueError(
                f"the sequence has {garment.shape[-2]} garment vertices, but the template has {len(self.template)}; "
                "project it with the garment that it was simulated with"
            )
        if len(garment) != len(state.betas):
            raise ValueError(
                f"{len(garment)} garment frames, but {len(state.betas)} body frames; cut both to one length"
            )
        broken = ~torch.isfinite(garment).all(dim=-1).all(dim=-1)
        if bool(broken.any()):
            raise ValueError(
                f"garment frame {int(broken.nonzero()[0])} holds NaN or infinity ({int(broken.sum())} such frames); "
                "drop the frames where the simulation diverged"
            )


@dataclass(frozen=True)
class ProjectionJob:
    """A sequence to project: its projector (garment), its frames, the body states they were simulated on."""

    projector: Projector
    garment: Float[Tensor, "T N 3"]
    state: BodyState


def project_all(jobs: Sequence[ProjectionJob], workers: int = 2) -> list[Projection]:
    """Many sequences at once, one thread each; the results do not depend on how many run together."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a thread a sequence beats threads inside small operations
    try:
        with ThreadPoolExecutor(workers) as pool:
            return list(pool.map(lambda job: job.projector.project(job.garment, job.state), jobs))
    finally:
        torch.set_num_threads(threads)


@dataclass(frozen=True)
class _Patch:
    """Loose (frame, vertex) pairs: those that may move, and a ring around them that holds still."""

    free: Bool[Tensor, "T N"]
    frame: Int[Tensor, "P"]
    vertex: Int[Tensor, "P"]
    moves: Bool[Tensor, "P"]
    triangles: RestTriangles  # faces index the pairs


@torch.no_grad()
def fixed_point(
    model: GarmentModel,
    target: Float[Tensor, "N 3"],
    state: BodyState,
    start: Float[Tensor, "N 3"],
    config: ProjectionConfig,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """X <- X + A(X)^-1 (M_G - M_G(X)) until a vertex is within tolerance; each vertex keeps the best X it has seen."""
    X, best = start.clone(), torch.full(start.shape[:-1], torch.inf, dtype=start.dtype)
    trial, active = start.clone(), torch.arange(len(start))
    for _ in range(config.fixed_point_steps):
        local = model.local_map(trial, state)
        residual = target[active] - local.posed(trial)
        error = residual.norm(dim=-1)
        better = error < best[active]
        X[active[better]], best[active[better]] = trial[better], error[better]
        going = error > config.tolerance
        if not bool(going.any()):
            break
        trial = (trial + local.pulled_back(residual))[going]
        active = active[going]
    return X, best


def levenberg_marquardt(
    model: GarmentModel,
    target: Float[Tensor, "P 3"],
    state: BodyState,
    start: Float[Tensor, "P 3"],
    config: ProjectionConfig,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P"]]:
    """Minimise |M_G - M_G(X)|^2 point by point with the exact Jacobian, each point in its own frame of `state`.

    Where weights change fast (armpits) the fixed point circles around the solution; this finds it, or the nearest miss.
    """
    X, damping = start.clone(), torch.full(start.shape[:-1], 1e-3, dtype=start.dtype)
    posed, jacobian = _posed_with_jacobian(model, X, state)
    residual, best = target - posed, (target - posed).norm(dim=-1)
    active = (best > config.tolerance).nonzero()[:, 0]
    identity = torch.eye(3, dtype=start.dtype)
    for _ in range(config.newton_steps):
        if len(active) == 0:
            break
        J = jacobian[active]
        normal = J.mT @ J + damping[active, None, None] * identity
        step = torch.linalg.solve(normal, (J.mT @ residual[active][..., None]))[..., 0]
        length = step.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        trial = X[active] + step * (config.newton_reach / length).clamp(max=1.0)
        posed, J = _posed_with_jacobian(model, trial, state[active])
        miss = target[active] - posed
        better = miss.norm(dim=-1) < best[active]
        chosen = active[better]
        X[chosen], residual[chosen], jacobian[chosen] = trial[better], miss[better], J[better]
        best[chosen] = miss[better].norm(dim=-1)
        damping[active] = torch.where(better, damping[active] / 5, damping[active] * 8).clamp(1e-6, 1e4)
        active = active[best[active] > config.tolerance]
    return X, best


def _posed_with_jacobian(
    model: GarmentModel, X: Float[Tensor, "P 3"], state: BodyState
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3 3"]]:
    """M_G of loose points and dM_G/dX: each point is posed three times, once for each row of its Jacobian."""
    copies = X.detach()[:, None].repeat(1, 3, 1).requires_grad_()
    with torch.enable_grad():
        posed = model.local_map(copies, state).posed(copies)
        (jacobian,) = torch.autograd.grad(posed.diagonal(dim1=-2, dim2=-1).sum(), copies)
    return posed[:, 0].detach(), jacobian


def _as_they_are(canonical: Float[Tensor, "T N 3"], bad: Bool[Tensor, "T N"]) -> Float[Tensor, "T N 3"]:
    return canonical


def neighbour_table(faces: Int[Tensor, "M 3"], vertex_count: int) -> Int[Tensor, "N D"]:
    """The vertices that share an edge with each vertex, padded with -1."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = torch.unique(torch.cat([edges, edges.flip(1)]), dim=0)
    counts = torch.bincount(edges[:, 0], minlength=vertex_count)
    first = counts.cumsum(0) - counts
    table = torch.full((vertex_count, int(counts.max())), -1)
    table[edges[:, 0], torch.arange(len(edges)) - first[edges[:, 0]]] = edges[:, 1]
    return table


def _dilated(mask: Bool[Tensor, "T N"], faces: Int[Tensor, "M 3"]) -> Bool[Tensor, "T N"]:
    """The mask and every vertex that shares a face with it."""
    touched = mask[:, faces].any(dim=-1)
    frame, face = touched.nonzero(as_tuple=True)
    grown = mask.clone()
    for corner in range(3):
        grown[frame, faces[face, corner]] = True
    return grown


def _chunks(length: int, size: int) -> Iterator[slice]:
    return (slice(begin, min(begin + size, length)) for begin in range(0, length, size))
