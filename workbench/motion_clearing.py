"""facts 9: the least rotation that takes arms off the body.  theta (T,J,3,3), beta -> theta with 30 mm of clearance.

Cloth cannot live where the body overlaps itself, so motion is made clear of it before it is simulated or judged.
Unknown is one small rotation x a limb and frame (three angles at the shoulder, the bend of the elbow; three at the
hip):

    min_x  sum_t |x_t|^2 + (tau fps)^4 sum_t |x_(t-1) - 2 x_t + x_(t+1)|^2 + mu sum_i max(0, c_i + margin - d_i(x))^2

d_i is the signed distance of sample i of the limb to the posed mesh of everything it must avoid, exact (closest point
of the real triangles) and linearised; each round solves the convex piecewise quadratic program by active sets on a
banded matrix.  c_i is the clearance, less where limb and body are neighbours already in the rest pose: near armpit
and crotch.  For a leg and the torso it goes by the skin that is met: a thigh owes nothing to the groin, all to the
belly.
Legs come first (each gives way to torso, head and the other), then arms (to torso, head, legs and each other).

Not handled: a forearm in its own upper arm, a shank in its own thigh, the head in a shoulder.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.linalg import solveh_banded
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skinning import Pose, RigidTransforms, linear_blend
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import vertex_normals
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.winding import winding_number
from workbench.motion import Motion

log = logging.getLogger(__name__)

# (root, hinge) of each limb, and the first joint of the head, in the two naming schemes that bodies come in.
NAMES = (
    {
        "left arm": ("LeftArm", "LeftForeArm"),
        "right arm": ("RightArm", "RightForeArm"),
        "left leg": ("LeftUpLeg", None),
        "right leg": ("RightUpLeg", None),
        "head": ("Neck", None),
    },
    {
        "left arm": ("left_shoulder", "left_elbow"),
        "right arm": ("right_shoulder", "right_elbow"),
        "left leg": ("left_hip", None),
        "right leg": ("right_hip", None),
        "head": ("neck", None),
    },
)
LIMBS = ("left arm", "right arm", "left leg", "right leg")
REACH = 0.15  # metres: what is farther off is not looked at
PAIR_REACH = 0.05  # the same between two limbs and between legs and torso, beyond the contact distance
FINGERS = 2.0  # samples are this much denser on the hand, where the surface is most curved
DOUBTFUL_DEPTH = 0.01  # metres inside from which vertex normals are not believed: ours, measured
CHUNK = 32  # frames posed at once: bounds the memory


@dataclass(frozen=True)
class ClearingConfig:
    """How far limbs stay off the body, and how smoothly they give way."""

    clearance: float = 0.030  # metres, arms to torso and legs: facts 9
    # metres, arm to arm and head, leg to leg and torso: ours, contact resolved with room for a cloth
    contact: float = 0.008
    near: float = 0.05  # metres to the body in rest pose up to which an arm's sample is exempt (armpit): ours
    far: float = 0.12  # and from which it owes the whole clearance; linear in between
    leg_near: float = 0.03  # the same between the legs (crotch)
    leg_far: float = 0.08
    # The same between a leg and the torso, but of the sample to the very skin that it meets: every deep bend folds skin
    # on skin, and who sits upright is to keep sitting (a hip bent by 92 degrees gives way by 6 to 10).  0.10 and 0.18
    # ask 16 to 23 there and leave 0.106 instead of 0.128 % of a T-shirt inside on 17 clips.  Asked of the sample to the
    # torso's nearest point, as it was before, thighs lay up to 45 mm in bellies: 0.213 %
    groin_near: float = 0.18
    groin_far: float = 0.26
    smoothing: float = 0.08  # seconds tau: giving way starts about 4 tau before contact: ours, see the strips
    margin: float = 0.002  # metres aimed at beyond what is owed, against the gaps between samples
    tolerance: float = 0.001  # metres short of what is owed that still count as clear
    stiffness: float = 1e5  # mu, rad^2 / m^2: 1 mm of one sample weighs like 0.3 rad in one frame
    all_samples: int = 500  # a limb; what clear means: the vertices between lack up to 3 mm at fingertips, else < 1 mm
    samples: int = 100  # of these to start with; those that stay short are taken in: ours, an exchange method
    exchanges: int = 3
    rounds: int = 14  # linearisations at most
    step: float = 0.2  # radians a round at most
    damping: float = 1.0  # rad^-2: weight of a round's change beside |x|^2, against overshooting
    settled: float = 0.03  # radians: clear and changing by less than this ends the rounds
    most_arm: float = 75.0  # degrees about one axis; what would need more stays and is reported: ours
    most_leg: float = 45.0
    meeting_gap: int = 6  # frames apart up to which two contacts of the same limbs are one meeting


@dataclass(frozen=True)
class ClearedMotion:
    """The cleared motion and what it took.  A limb's columns: left arm, right arm, left leg, right leg."""

    motion: Motion
    added: Float[np.ndarray, "T 4"]  # degrees of rotation added
    shortfall_before: Float[np.ndarray, "T"]  # metres that the worst sample lacks of what it owes; 0 where clear
    shortfall_after: Float[np.ndarray, "T"]
    distance_before: Float[
        np.ndarray, "T"
    ]  # metres, least signed distance (at most REACH) of arm samples that owe the whole
    distance_after: Float[np.ndarray, "T"]  # clearance to torso and legs; negative inside
    unresolved: Bool[np.ndarray, "T"]  # frames still short by more than the tolerance


@dataclass(frozen=True)
class Part:
    """A closed piece of the body: its faces, with every hole capped by a fan around the mean of its rim."""

    vertices: Int[np.ndarray, "V"]  # of the body
    faces: Int[np.ndarray, "F 3"]  # into `vertices`, then one cap centre a rim
    rims: tuple[Int[np.ndarray, "_"], ...]  # into `vertices`

    def with_centres(self, values: Float[np.ndarray, "N *C"]) -> Float[np.ndarray, "W *C"]:
        """Values a body vertex -> values a vertex of the part; a cap's centre takes the mean of its rim."""
        own = values[self.vertices]
        return np.concatenate([own, *(own[rim].mean(0, keepdims=True) for rim in self.rims)])


def closed_part(faces: Int[Tensor, "F 3"], chosen: Bool[Tensor, "V"]) -> Part:
    """Faces with at least two chosen corners, closed."""
    kept = faces[chosen[faces].sum(1) >= 2]
    vertices, local = torch.unique(kept, return_inverse=True)
    rims = _rims(local.numpy())
    fans = [local.numpy()]
    for cap, rim in enumerate(rims):
        centre = np.full(len(rim), len(vertices) + cap)
        fans.append(np.stack([np.roll(rim, -1), rim, centre], 1))
    return Part(vertices.numpy(), np.concatenate(fans), rims)


def _rims(faces: Int[np.ndarray, "F 3"]) -> tuple[Int[np.ndarray, "_"], ...]:
    """Boundary loops in the direction of the faces: geometry.mesh.boundary_loops, much faster on a whole body."""
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(faces.max()) + 1
    border = half[~np.isin(half[:, 0] * count + half[:, 1], half[:, 1] * count + half[:, 0])]
    following = {int(a): int(b) for a, b in border}
    if len(following) < len(border):
        raise ValueError("a part of the body has two boundary loops that touch; this body cannot be cleared")
    rims = []
    while following:
        rim = [next(iter(following))]
        while (after := following.pop(rim[-1])) != rim[0]:
            rim.append(after)
        rims.append(np.array(rim))
    return tuple(rims)


@dataclass(frozen=True)
class Points:
    """Points of the body that can be posed alone."""

    rest: Float[Tensor, "N 3"]
    pose_directions: Float[Tensor, "P N 3"]
    weights: Float[Tensor, "N J"]

    def posed(self, pose: Pose, coefficients: Float[Tensor, "T P"]) -> Float[Tensor, "T N 3"]:
        P = len(self.pose_directions)
        offsets = (coefficients @ self.pose_directions.reshape(P, -1)).unflatten(-1, (-1, 3))
        return linear_blend(self.rest + offsets, self.weights, pose.transforms)


@dataclass(frozen=True)
class Surface:
    """The vertices of a part, and the normals of its rest pose."""

    points: Points
    normals: Float[np.ndarray, "N 3"]


@dataclass(frozen=True)
class Limb:
    """A limb that may turn: where, what it carries, and what its samples owe."""

    name: str
    root: int
    hinge: int | None
    samples: Points
    by_root: Float[np.ndarray, "N"]  # share of each sample that moves with the root joint
    by_hinge: Float[np.ndarray, "N"]
    owed_to_trunk: Float[np.ndarray, "N"]  # metres: torso and legs; of a leg the most, see `owed_to_skin`
    owed_to_head: Float[np.ndarray, "N"]
    owed_to_other: Float[np.ndarray, "N"]  # the same limb of the other side
    part: Part
    surface: Surface
    surface_by_root: Float[np.ndarray, "V"]
    surface_by_hinge: Float[np.ndarray, "V"]

    def with_samples(self, index: Int[np.ndarray, " S"]) -> "Limb":
        """The same limb, watched at some of its samples."""
        points = self.samples
        return replace(
            self,
            samples=Points(points.rest[index], points.pose_directions[:, index], points.weights[index]),
            by_root=self.by_root[index],
            by_hinge=self.by_hinge[index],
            owed_to_trunk=self.owed_to_trunk[index],
            owed_to_head=self.owed_to_head[index],
            owed_to_other=self.owed_to_other[index],
        )


@dataclass(frozen=True)
class Core:
    """What limbs must avoid and cannot move: for arms the rest of the body, for legs torso and head."""

    part: Part
    surface: Surface
    head_faces: Bool[np.ndarray, "F"]


@dataclass(frozen=True)
class Rows:
    """Linearised distances: d_i(x) = distance + gradient . (x_frame - x0_frame)."""

    limb: Int[np.ndarray, "N"]  # 0 left, 1 right
    sample: Int[np.ndarray, "N"]  # of the limb
    frame: Int[np.ndarray, "N"]
    gradient: Float[np.ndarray, "N D"]
    distance: Float[np.ndarray, "N"]
    owed: Float[np.ndarray, "N"]
    whole: Bool[np.ndarray, "N"]  # the sample owes the whole clearance to torso or legs
    exit: Float[np.ndarray, "N 3"]  # between the two limbs: the way the left one leaves, in the trunk's frame; else 0

    @staticmethod
    def none(freedoms: int) -> "Rows":
        empty, index = np.zeros(0), np.zeros(0, int)
        nothing = np.zeros(0, bool)
        return Rows(index, index, index, np.zeros((0, freedoms)), empty, empty, nothing, np.zeros((0, 3)))


def clear(
    motion: Motion, body: Body, betas: Float[Tensor, "K"] | None = None, config: ClearingConfig = ClearingConfig()
) -> Motion:
    """The nearest motion that keeps arms off the body, limbs out of each other and legs out of the torso; see
    `clear_and_report`."""
    return clear_and_report(motion, body, betas, config).motion


def clear_and_report(
    motion: Motion, body: Body, betas: Float[Tensor, "K"] | None = None, config: ClearingConfig = ClearingConfig()
) -> ClearedMotion:
    """Turn shoulders, elbows and hips by the least and smoothest rotation that clears the body of this shape.

    betas (K): body shape, by default the mean.  A motion that is clear already comes back unchanged.
    Frames that stay short of their clearance are named in `unresolved`, with a warning in the log.
    Raises ValueError for another skeleton than the body's, wrong betas, NaN.
    """
    betas = body.mean_shape() if betas is None else betas
    _check(motion, body, betas)
    legs, arms, torso, core = _limbs(body, betas, config)
    leg_stage = Stage(body, betas, motion.fps, legs, torso, config)
    after_legs, leg_added, leg_before, leg_after = leg_stage.solve(motion.rotations)
    arm_stage = Stage(body, betas, motion.fps, arms, core, config)
    rotations, arm_added, arm_before, arm_after = arm_stage.solve(after_legs)
    shortfall = np.maximum(leg_after.shortfall, arm_after.shortfall)
    unresolved = shortfall > config.tolerance
    if unresolved.any():
        log.warning(
            "motion %r: %d of %d frames stay up to %.1f mm short of their clearance",
            motion.name,
            int(unresolved.sum()),
            len(motion),
            1e3 * float(shortfall.max()),
        )
    return ClearedMotion(
        motion=replace(motion, rotations=rotations),
        added=np.concatenate([arm_added, leg_added], axis=1),
        shortfall_before=np.maximum(leg_before.shortfall, arm_before.shortfall),
        shortfall_after=shortfall,
        distance_before=arm_before.distance,
        distance_after=arm_after.distance,
        unresolved=unresolved,
    )


@dataclass(frozen=True)
class State:
    """Where a motion stands: per frame, the worst shortfall and the least distance to torso and legs."""

    shortfall: Float[np.ndarray, "T"]
    distance: Float[np.ndarray, "T"]


class Stage:
    """Two limbs that give way together, arms or legs, to each other and to a core that does not move."""

    def __init__(
        self,
        body: Body,
        betas: Float[Tensor, "K"],
        fps: float,
        limbs: tuple[Limb, Limb],
        core: Core,
        config: ClearingConfig,
    ):
        self.body, self.betas, self.limbs, self.core, self.config = body, betas, limbs, core, config
        self.smoothness = (config.smoothing * fps) ** 4
        self.still: dict[int, np.ndarray] = {}  # the core as last posed, by first frame of the chunk
        self.meshes: dict[int, ClosestPoint] = {}  # one a part, moved from frame to frame
        self.use(tuple(np.arange(len(limb.by_root)) for limb in limbs))
        self.freedoms = 3 if limbs[0].hinge is None else 4
        legs = limbs[0].hinge is None
        self.most = np.deg2rad(config.most_leg if legs else config.most_arm)
        self.reach = config.contact + PAIR_REACH if legs else REACH  # of the core: how far off it is looked at

    def solve(self, rotations: Float[Tensor, "T J 3 3"]) -> tuple[Tensor, np.ndarray, State, State]:
        """(rotations, degrees added (T,2), state before, state after).

        Exchange method: descend with few samples, look at all of them, take in those that are short, and again.
        """
        T, config = len(rotations), self.config
        bend = [_bend(rotations, self.body, limb) for limb in self.limbs]
        x = best = np.zeros((T, 2 * self.freedoms))
        everything = tuple(np.arange(len(limb.by_root)) for limb in self.limbs)
        chosen = tuple(index[: config.samples] for index in everything)
        self.use(everything)
        rows = self.rows(rotations, x, bend, np.zeros((T, 3)))
        before = after = _state(rows, T)
        ways, least = _ways_out(rows, T, config), np.inf
        for exchange in range(config.exchanges):
            if after.shortfall.max() <= config.tolerance:
                break
            chosen = tuple(
                np.union1d(index, self.worst(rows, k)[: config.samples // 4]) for k, index in enumerate(chosen)
            )
            self.use(chosen)
            x = self.descend(rotations, x, bend, ways, config.rounds if exchange == 0 else config.rounds // 2)
            self.use(everything)
            rows = self.rows(rotations, x, bend, ways)
            cost = _cost(rows, x, self.smoothness, config)
            if cost < least:
                best, least, after = x, cost, _state(rows, T)
        self.still.clear()
        turned = self.turned(rotations, best, bend) if np.any(best) else rotations
        return turned, self.degrees(best, bend), before, after

    def descend(
        self,
        rotations: Float[Tensor, "T J 3 3"],
        x: Float[np.ndarray, "T D"],
        bend: Sequence["Bend | None"],
        ways: Float[np.ndarray, "T 3"],
        rounds: int,
    ) -> Float[np.ndarray, "T D"]:
        """Rounds of linearising and solving; the best x met."""
        config, T = self.config, len(x)
        best, least = x, np.inf
        rows = self.rows(rotations, x, bend, ways)
        for turn in range(rounds):
            last, x = x, np.clip(_least_rotation(rows, x, self.smoothness, config), -self.most, self.most)
            rows = self.rows(rotations, x, bend, ways, fresh=turn % 4 == 3)
            cost = _cost(rows, x, self.smoothness, config)
            if cost < least:
                best, least = x, cost
            if _state(rows, T).shortfall.max() <= 0 and np.abs(x - last).max() < config.settled:
                break
        return best

    def use(self, chosen: Sequence[Int[np.ndarray, "_"]]) -> None:
        """Look at these samples of each limb from now on."""
        self.chosen = tuple(chosen)
        self.working = tuple(limb.with_samples(index) for limb, index in zip(self.limbs, chosen))

    def worst(self, rows: Rows, k: int) -> Int[np.ndarray, " N"]:
        """Samples of limb k that are short of what they aim at, the worst first."""
        mine = (rows.limb == k) & (rows.owed > 0)
        short = np.zeros(len(self.limbs[k].by_root))
        np.maximum.at(short, rows.sample[mine], (rows.owed - rows.distance)[mine])
        order = np.argsort(-short)
        return order[short[order] > 0]

    def turned(
        self, rotations: Float[Tensor, "T J 3 3"], x: Float[np.ndarray, "T D"], bend: Sequence["Bend | None"]
    ) -> Float[Tensor, "T J 3 3"]:
        """The motion with the rotations x applied."""
        result = rotations.clone()
        for k, limb in enumerate(self.limbs):
            own = torch.from_numpy(x[:, k * self.freedoms : (k + 1) * self.freedoms]).to(rotations)
            result[:, limb.root] = axis_angle_to_matrix(own[:, :3]) @ rotations[:, limb.root]
            elbow = bend[k]
            if limb.hinge is not None and elbow is not None:
                turn = torch.from_numpy(elbow.applied(x[:, k * self.freedoms + 3])[:, None] * elbow.axis).to(rotations)
                result[:, limb.hinge] = axis_angle_to_matrix(turn) @ rotations[:, limb.hinge]
        return result

    def degrees(self, x: Float[np.ndarray, "T D"], bend: Sequence["Bend | None"]) -> Float[np.ndarray, "T 2"]:
        """Rotation added to each limb: at its root and, for arms, at the elbow."""
        total = []
        for k in range(2):
            own = x[:, k * self.freedoms : (k + 1) * self.freedoms]
            angle = np.linalg.norm(own[:, :3], axis=1)
            elbow = bend[k]
            total.append(angle if elbow is None else angle + np.abs(elbow.applied(own[:, 3])))
        return np.rad2deg(np.stack(total, 1))

    def rows(
        self,
        rotations: Float[Tensor, "T J 3 3"],
        x: Float[np.ndarray, "T D"],
        bend: Sequence["Bend | None"],
        ways: Float[np.ndarray, "T 3"],
        *,
        fresh: bool = True,
    ) -> Rows:
        """Distances of all samples nearer than REACH and how they change with x; ways: see `_ways_out`.

        fresh: pose the core anew (turning arms hardly moves it); False takes it from the last call.
        """
        turned = self.turned(rotations, x, bend)
        found: list[Rows] = []
        for start in range(0, len(x), CHUNK):
            chunk = np.arange(start, min(start + CHUNK, len(x)))
            theta = turned[chunk]
            pose = self.body.pose(theta, self.betas)
            coefficients = self.body.pose_coefficients(theta)
            samples = [limb.samples.posed(pose, coefficients).numpy() for limb in self.working]
            levers = [
                _levers(
                    limb, pose, theta, x[chunk, k * self.freedoms : k * self.freedoms + 3], bend[k], chunk, self.body
                )
                for k, limb in enumerate(self.working)
            ]
            turns = pose.transforms.rotation.numpy()
            if fresh or start not in self.still:
                self.still[start] = self.core.surface.points.posed(pose, coefficients).numpy()
            found.append(self._core_rows(chunk, samples, self.still[start], levers, turns))
            close = np.flatnonzero(_boxes_meet(samples[0], samples[1], self.config.contact + 2 * PAIR_REACH))
            if len(close):
                near = Pose(
                    RigidTransforms(pose.transforms.rotation[close], pose.transforms.translation[close]),
                    pose.joints[close],
                )
                for k in range(2):
                    surface = self.limbs[1 - k].surface.points.posed(near, coefficients[close]).numpy()
                    found.append(self._pair_rows(k, chunk, close, samples[k][close], surface, levers, turns, ways))
        found.append(Rows.none(2 * self.freedoms))
        return Rows(*(np.concatenate([getattr(rows, field.name) for rows in found]) for field in fields(Rows)))

    def _core_rows(
        self,
        frames: Int[np.ndarray, "S"],
        samples: Sequence[np.ndarray],
        still: Float[np.ndarray, "S V 3"],
        levers: Sequence["Levers"],
        turns: Float[np.ndarray, "S J 3 3"],
    ) -> Rows:
        """Samples of both limbs against what does not give way."""
        core, first = self.core, samples[0].shape[1]
        owed_trunk = np.concatenate([limb.owed_to_trunk for limb in self.working])
        owed_head = np.concatenate([limb.owed_to_head for limb in self.working])
        cloud = np.concatenate(samples, axis=1)
        owes = _in_box(cloud, still, self.reach) & (owed_trunk > 0)
        hit = _signed(core.part, core.surface, still, cloud, owes, turns, self.meshes)
        head = core.head_faces[hit.face]
        gradient = np.zeros((len(hit.face), 2 * self.freedoms))
        for k, limb in enumerate(self.working):
            mine = np.flatnonzero((hit.sample >= first) == bool(k))
            which = hit.sample[mine] - k * first
            gradient[mine, k * self.freedoms : (k + 1) * self.freedoms] = levers[k].gradient(
                hit.frame[mine], hit.query[mine], hit.normal[mine], limb.by_root[which], limb.by_hinge[which]
            )
        of_right = hit.sample >= first
        if self.limbs[0].hinge is None:
            own = np.concatenate([limb.samples.rest.numpy() for limb in self.working])[hit.sample]
            owed = owed_to_skin(own, core, hit.vertices, hit.share, self.config)
        else:
            owed = np.where(head, owed_head[hit.sample], owed_trunk[hit.sample])
        return Rows(
            limb=of_right.astype(int),
            sample=np.concatenate(self.chosen)[hit.sample],
            frame=frames[hit.frame],
            gradient=gradient,
            distance=hit.distance,
            owed=owed,
            whole=~head & (owed_trunk[hit.sample] >= self.config.clearance),
            exit=np.zeros((len(hit.face), 3)),
        )

    def _pair_rows(
        self,
        k: int,
        frames: Int[np.ndarray, "S"],
        close: Int[np.ndarray, "C"],
        samples: Float[np.ndarray, "C N 3"],
        surface: Float[np.ndarray, "C V 3"],
        levers: Sequence["Levers"],
        turns: Float[np.ndarray, "S J 3 3"],
        ways: Float[np.ndarray, "T 3"],
    ) -> Rows:
        """Samples of limb k against the other limb's mesh, which gives way too, at the `close` frames of the chunk."""
        limb, other = self.working[k], self.working[1 - k]
        near = _in_box(samples, surface, self.config.contact + PAIR_REACH) & (limb.owed_to_other > 0)
        hit = _signed(other.part, other.surface, surface, samples, near, turns[close], self.meshes)
        hit = replace(hit, frame=close[hit.frame])
        owed = limb.owed_to_other[hit.sample]
        side = 1.0 if k == 0 else -1.0
        trunk = turns[hit.frame, self.body.parents[self.limbs[0].root]]
        leave = side * np.einsum("nij,ni->nj", trunk, hit.normal)
        # where limbs have gone through each other, nearest exits contradict: one way out a meeting
        away = side * np.einsum("nij,nj->ni", trunk, ways[frames[hit.frame]])
        against = (hit.distance < owed) & ((hit.normal * away).sum(1) < 0.3) & (np.abs(away).sum(1) > 0)
        normal = np.where(against[:, None], away, hit.normal)
        gradient = np.zeros((len(hit.face), 2 * self.freedoms))
        own = slice(k * self.freedoms, (k + 1) * self.freedoms)
        theirs = slice((1 - k) * self.freedoms, (2 - k) * self.freedoms)
        gradient[:, own] = levers[k].gradient(
            hit.frame, hit.query, normal, limb.by_root[hit.sample], limb.by_hinge[hit.sample]
        )
        by_root = (other.surface_by_root[hit.vertices] * hit.share).sum(1)
        by_hinge = (other.surface_by_hinge[hit.vertices] * hit.share).sum(1)
        gradient[:, theirs] = -levers[1 - k].gradient(hit.frame, hit.point, normal, by_root, by_hinge)
        return Rows(
            limb=np.full(len(owed), k),
            sample=self.chosen[k][hit.sample],
            frame=frames[hit.frame],
            gradient=gradient,
            distance=hit.distance,
            owed=owed,
            whole=np.zeros(len(owed), bool),
            exit=leave,
        )


def _in_box(
    points: Float[np.ndarray, "S N 3"], cloud: Float[np.ndarray, "S M 3"], reach: float
) -> Bool[np.ndarray, "S N"]:
    """Points in the bounding box of a cloud, or no farther than `reach` from it along any axis."""
    low, high = cloud.min(1, keepdims=True) - reach, cloud.max(1, keepdims=True) + reach
    return ((points > low) & (points < high)).all(2)


def _boxes_meet(
    one: Float[np.ndarray, "S N 3"], other: Float[np.ndarray, "S M 3"], reach: float
) -> Bool[np.ndarray, "S"]:
    """Frames at which the bounding boxes of two clouds are nearer than `reach` along every axis."""
    gap = np.maximum(one.min(1) - other.max(1), other.min(1) - one.max(1))
    return np.all(gap < reach, axis=1)


@dataclass(frozen=True)
class Hit:
    """Closest points nearer than REACH, with a sign: positive outside.  One row a sample and frame."""

    frame: Int[np.ndarray, "N"]  # within the chunk
    sample: Int[np.ndarray, "N"]
    query: Float[np.ndarray, "N 3"]  # the sample
    face: Int[np.ndarray, "N"]
    point: Float[np.ndarray, "N 3"]  # its closest point
    distance: Float[np.ndarray, "N"]
    normal: Float[np.ndarray, "N 3"]  # the direction in which the distance grows
    vertices: Int[np.ndarray, "N 3"]  # of the face
    share: Float[np.ndarray, "N 3"]  # barycentric


def _signed(
    part: Part,
    surface: Surface,
    posed: Float[np.ndarray, "S V 3"],
    samples: Float[np.ndarray, "S N 3"],
    asked: Bool[np.ndarray, "S N"],
    turns: Float[np.ndarray, "S J 3 3"],
    meshes: dict[int, ClosestPoint],
) -> Hit:
    """Signed distances of the samples that are asked for, all frames of a chunk.

    Three judges of the side, each called where the one before says "inside": the face's normal; the vertex normals,
    turned with the skin (folds and sharp rims mislead a face); deeper than DOUBTFUL_DEPTH, the exact winding number.
    """
    columns: list[tuple[np.ndarray, ...]] = []
    for s in np.flatnonzero(asked.any(1)):
        if id(part) not in meshes:
            meshes[id(part)] = ClosestPoint(posed[s], part.faces)
        mesh = meshes[id(part)]
        mesh.refit(posed[s])
        which = np.flatnonzero(asked[s])
        hit = mesh.query(samples[s, which])
        kept = np.flatnonzero(hit.distance < REACH)
        columns.append(
            (
                np.full(len(kept), s),
                which[kept],
                samples[s, which[kept]],
                hit.face[kept],
                hit.point[kept],
                hit.distance[kept].astype(np.float64),
                hit.barycentric[kept],
            )
        )
    if not columns:
        none, vector = np.zeros(0, int), np.zeros((0, 3))
        return Hit(none, none, vector, none, vector, np.zeros(0), vector, np.zeros((0, 3), int), vector)
    frame, sample, query, face, point, distance, share = (np.concatenate(column) for column in zip(*columns))
    corners = part.faces[face]
    away = query - point
    a, b, c = (posed[frame, corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    sign = np.ones(len(frame))
    claimed = np.flatnonzero((away * normal).sum(1) < 0)
    blended = surface.points.weights.numpy()[corners[claimed]] @ turns[frame[claimed]].reshape(
        len(claimed), turns.shape[1], 9
    )
    skin = (blended.reshape(-1, 3, 3, 3) @ surface.normals[corners[claimed]][..., None])[..., 0]
    inner = claimed[(away[claimed] * (share[claimed, :, None] * skin).sum(1)).sum(1) < 0]
    sign[inner] = -1.0
    deep = inner[distance[inner] > DOUBTFUL_DEPTH]
    for s in np.unique(frame[deep]):
        here = deep[frame[deep] == s]
        sign[here] = np.where(winding_number(query[here], posed[s], part.faces) > 0.5, -1.0, 1.0)
    sure = distance > 1e-5
    direction = np.where(sure[:, None], (sign / np.maximum(distance, 1e-5))[:, None] * away, normal)
    return Hit(frame, sample, query, face, point, sign * distance, direction, corners, share)


@dataclass(frozen=True)
class Bend:
    """The hinge of a limb: it bends and straightens about its present axis, never past straight."""

    axis: Float[np.ndarray, "T 3"]  # in the frame of the root joint
    angle: Float[np.ndarray, "T"]  # radians from straight
    gain: Float[np.ndarray, "T"]  # 0 where a straight limb has no axis

    def applied(self, x: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        """Radians really added for the unknown x."""
        return np.clip(self.gain * x, -0.9 * self.angle, np.maximum(0, MOST_BENT - self.angle))


MOST_BENT = np.deg2rad(150.0)
BEND_FROM, BEND_FULLY = np.deg2rad(15.0), np.deg2rad(45.0)


def _bend(rotations: Float[Tensor, "T J 3 3"], body: Body, limb: Limb) -> Bend | None:
    if limb.hinge is None:
        return None
    child = body.parents.index(limb.hinge)
    rest = body.joint_template.double()
    upper = torch.nn.functional.normalize(rest[limb.hinge] - rest[limb.root], dim=0)
    lower = torch.nn.functional.normalize(rest[child] - rest[limb.hinge], dim=0)
    bent = rotations[:, limb.hinge].double() @ lower
    axis = torch.linalg.cross(upper.expand_as(bent), bent)
    angle = torch.atan2(axis.norm(dim=-1), bent @ upper).numpy()
    s = np.clip((angle - BEND_FROM) / (BEND_FULLY - BEND_FROM), 0, 1)
    return Bend(torch.nn.functional.normalize(axis, dim=-1).numpy(), angle, s * s * (3 - 2 * s))


@dataclass(frozen=True)
class Levers:
    """Where a limb turns, in the world, at the frames of a chunk."""

    root: Float[np.ndarray, "S 3"]
    axes: Float[np.ndarray, "S 3 3"]  # columns: where the three unknowns turn the limb about
    hinge: Float[np.ndarray, "S 3"] | None
    hinge_axis: Float[np.ndarray, "S 3"] | None  # times its gain

    def gradient(
        self,
        s: Int[np.ndarray, "N"],
        points: Float[np.ndarray, "N 3"],
        normals: Float[np.ndarray, "N 3"],
        by_root: Float[np.ndarray, "N"],
        by_hinge: Float[np.ndarray, "N"],
    ) -> Float[np.ndarray, "N D"]:
        """d(normal . point)/dx of points carried by the limb, each at its frame s of the chunk."""
        moment = np.cross(points - self.root[s], normals)
        columns = by_root[:, None] * np.einsum("ni,nij->nj", moment, self.axes[s])
        if self.hinge is None or self.hinge_axis is None:
            return columns
        bend = by_hinge * (np.cross(points - self.hinge[s], normals) * self.hinge_axis[s]).sum(1)
        return np.concatenate([columns, bend[:, None]], 1)


def _levers(
    limb: Limb,
    pose: Pose,
    theta: Float[Tensor, "S J 3 3"],
    turn: Float[np.ndarray, "S 3"],
    bend: Bend | None,
    frames: Int[np.ndarray, "S"],
    body: Body,
) -> Levers:
    world = pose.transforms.rotation.double().numpy()
    joints = pose.joints.double().numpy()
    axes = world[:, body.parents[limb.root]] @ left_jacobian(turn)
    if limb.hinge is None or bend is None:
        return Levers(joints[:, limb.root], axes, None, None)
    hinge_axis = np.einsum("sab,sb->sa", world[:, limb.root], bend.axis[frames]) * bend.gain[frames, None]
    return Levers(joints[:, limb.root], axes, joints[:, limb.hinge], hinge_axis)


def left_jacobian(w: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 3 3"]:
    """J with exp(w + dw) = exp(J dw) exp(w) to first order (Sola et al. 2018, Eq. 145)."""
    squared = (w * w).sum(1)[:, None, None]
    small = squared < 1e-6
    angle = np.sqrt(np.where(small, 1.0, squared))
    first = np.where(small, 0.5 - squared / 24, (1 - np.cos(angle)) / angle**2)
    second = np.where(small, 1 / 6 - squared / 120, (angle - np.sin(angle)) / angle**3)
    K = np.zeros((len(w), 3, 3))
    K[:, 2, 1], K[:, 0, 2], K[:, 1, 0] = w.T
    K[:, 1, 2], K[:, 2, 0], K[:, 0, 1] = -w.T
    return np.eye(3) + first * K + second * (K @ K)


def _ways_out(rows: Rows, frames: int, config: ClearingConfig) -> Float[np.ndarray, "T 3"]:
    """The direction in which the left limb leaves the right one, one a meeting, in the trunk's frame; else 0.

    The mean of the nearest exits by depth, with a leaning to the left: a limb that passes through another has exits on
    both sides.
    """
    short = np.clip(rows.owed - rows.distance, 0, 0.05) * (np.abs(rows.exit).sum(1) > 0) * (rows.owed > 0)
    total = np.stack([np.bincount(rows.frame, short * rows.exit[:, i], frames) for i in range(3)], 1)
    weight = np.bincount(rows.frame, short, frames)
    ways = np.zeros((frames, 3))
    touching = np.flatnonzero(weight > 0)
    for meeting in np.split(touching, np.flatnonzero(np.diff(touching) > config.meeting_gap) + 1):
        if len(meeting):
            way = total[meeting].sum(0) + 0.3 * weight[meeting].sum() * np.array([1.0, 0, 0])
            first, last = max(0, meeting[0] - config.meeting_gap), meeting[-1] + config.meeting_gap + 1
            ways[first:last] = way / (np.linalg.norm(way) + 1e-12)
    return ways


def _state(rows: Rows, frames: int) -> State:
    shortfall, distance = np.zeros(frames), np.full(frames, REACH)
    np.maximum.at(shortfall, rows.frame, np.where(rows.owed > 0, rows.owed - rows.distance, 0.0))
    np.minimum.at(distance, rows.frame[rows.whole], rows.distance[rows.whole])
    return State(shortfall, distance)


def _cost(rows: Rows, x: Float[np.ndarray, "T D"], smoothness: float, config: ClearingConfig) -> float:
    """The sum in this file's first lines, with the distances as they are."""
    rotation = (x**2).sum()
    smooth = (np.diff(x, 2, axis=0) ** 2).sum()
    short = np.maximum(0, rows.owed + config.margin - rows.distance)[rows.owed > 0]
    return float(rotation + smoothness * smooth + config.stiffness * (short**2).sum())


def _least_rotation(
    rows: Rows, x: Float[np.ndarray, "T D"], smoothness: float, config: ClearingConfig
) -> Float[np.ndarray, "T D"]:
    """The minimum over x of the sum in this file's first lines with linearised distances, by active sets."""
    T, D = x.shape
    aim = rows.owed + config.margin
    keep = (rows.owed > 0) & (rows.distance < aim + config.step * 0.5)
    frame, g, aim, distance = rows.frame[keep], rows.gradient[keep], aim[keep], rows.distance[keep]
    offset = distance - (g * x[frame]).sum(1)  # distance = offset + g . x
    base = _smooth_rotation_matrix(T, D, smoothness)
    base[-1] += config.damping
    solution = x
    for _ in range(8):
        short = aim - offset - (g * solution[frame]).sum(1) > 0
        matrix, right = base.copy(), np.zeros((T, D))
        blocks = np.zeros((T, D, D))
        a, t = g[short], frame[short]
        for i in range(D):
            right[:, i] = config.stiffness * np.bincount(t, a[:, i] * (aim - offset)[short], T)
            for j in range(i, D):
                blocks[:, i, j] = config.stiffness * np.bincount(t, a[:, i] * a[:, j], T)
        for i in range(D):
            for j in range(i, D):
                # upper banded storage: entry (r, c) is at [bands + r - c, c]
                matrix[2 * D + i - j, j::D] += blocks[:, i, j]
        right += config.damping * x
        previous, solution = solution, solveh_banded(matrix, right.ravel()).reshape(T, D)
        if np.abs(solution - previous).max() < 1e-5:
            break
    longest = np.abs(solution - x).max(1, keepdims=True)
    return x + (solution - x) * np.minimum(1, config.step / np.maximum(longest, 1e-9))


def _smooth_rotation_matrix(T: int, D: int, smoothness: float) -> Float[np.ndarray, "B N"]:
    """sum |x_t|^2 + smoothness * sum |second difference|^2 as an upper banded matrix, frame-major."""
    bands = np.zeros((2 * D + 1, T * D))
    diagonal, first, second = np.ones(T), np.zeros(T), np.zeros(T)
    if T >= 3:
        for offset, value in ((0, 1.0), (1, 4.0), (2, 1.0)):
            diagonal[offset : T - 2 + offset] += smoothness * value
        first[1 : T - 1] += -2 * smoothness
        first[2:T] += -2 * smoothness
        second[2:T] += smoothness
    bands[2 * D] = np.repeat(diagonal, D)
    bands[D] = np.repeat(first, D)
    bands[0] = np.repeat(second, D)
    return bands


# ---- parts of the body


def _limbs(body: Body, betas: Float[Tensor, "K"], config: ClearingConfig) -> tuple:
    """(legs, arms, what legs avoid, what arms avoid) of a body shape."""
    skeleton = body.skeleton
    names = next((scheme for scheme in NAMES if scheme["left arm"][0] in skeleton.names), None)
    if names is None:
        raise ValueError(
            f"body '{body.name}' has no joint called {NAMES[0]['left arm'][0]} or {NAMES[1]['left arm'][0]}: clearing "
            "needs to know arms and legs; name the joints as the default body's or as SMPL's"
        )
    carried = {part: torch.tensor(skeleton.descendants(skeleton.index(joint))) for part, (joint, _) in names.items()}
    owner = body.weights.argmax(1)
    belongs = {part: torch.isin(owner, joints) for part, joints in carried.items()}
    rest = body.template + body.shape_offsets(betas)
    parts = {part: closed_part(body.faces, belongs[part]) for part in LIMBS}
    armless = ~(belongs["left arm"] | belongs["right arm"])
    torso, core = (
        Core(part, _surface(body, rest, part), _faces_of(part, belongs["head"]))
        for part in (
            closed_part(body.faces, armless & ~(belongs["left leg"] | belongs["right leg"])),
            closed_part(body.faces, armless),
        )
    )

    def limb(name: str, other: str, still: Part) -> Limb:
        root, hinge = (None if joint is None else skeleton.index(joint) for joint in names[name])
        assert root is not None
        own = np.flatnonzero(belongs[name].numpy())
        points = rest[own].numpy()

        def off(part: Part) -> Float[np.ndarray, "N"]:
            return ClosestPoint(part.with_centres(rest.numpy()), part.faces).query(points).distance

        to_other_part = off(parts[other])
        if hinge is None:
            to_trunk = to_head = np.full(len(own), config.contact)  # at most, see `owed_to_skin`
            to_other = _owed(to_other_part, config.contact, config.leg_near, config.leg_far)
        else:
            to_core = off(still)
            to_trunk = _owed(to_core, config.clearance, config.near, config.far)
            to_head = _owed(to_core, config.contact, config.near, config.far)
            to_other = _owed(to_other_part, config.contact, config.near, config.far)
        cloud = points
        if hinge is not None:
            end = skeleton.children(hinge)[0]
            joint = body.joints(betas)[end].numpy()
            hand = np.isin(owner.numpy()[own], skeleton.descendants(end))[:, None]
            cloud = np.where(hand, joint + FINGERS * (points - joint), points)
        chosen = _spread(cloud, np.maximum(to_trunk, to_other) > 0, config.all_samples)
        by_root = body.weights[:, carried[name]].sum(1).double().numpy()
        below = torch.tensor(skeleton.descendants(hinge)) if hinge is not None else torch.zeros(0, dtype=torch.long)
        by_hinge = body.weights[:, below].sum(1).double().numpy()
        return Limb(
            name=name,
            root=root,
            hinge=hinge,
            samples=_points(body, rest, own[chosen]),
            by_root=by_root[own[chosen]],
            by_hinge=by_hinge[own[chosen]],
            owed_to_trunk=to_trunk[chosen],
            owed_to_head=to_head[chosen],
            owed_to_other=to_other[chosen],
            part=parts[name],
            surface=_surface(body, rest, parts[name]),
            surface_by_root=parts[name].with_centres(by_root),
            surface_by_hinge=parts[name].with_centres(by_hinge),
        )

    legs = (limb("left leg", "right leg", torso.part), limb("right leg", "left leg", torso.part))
    arms = (limb("left arm", "right arm", core.part), limb("right arm", "left arm", core.part))
    return legs, arms, torso, core


def _owed(distance_in_rest: Float[np.ndarray, "N"], clearance: float, near: float, far: float) -> np.ndarray:
    """c_i: nothing up to `near` in the rest pose, all of it from `far`."""
    return clearance * np.clip((distance_in_rest - near) / (far - near), 0, 1).astype(np.float64)


def owed_to_skin(
    rest: Float[np.ndarray, "N 3"],
    torso: Core,
    vertices: Int[np.ndarray, "N 3"],
    share: Float[np.ndarray, "N 3"],
    config: ClearingConfig,
) -> Float[np.ndarray, "N"]:
    """What places of a leg owe to the places of the torso that they meet, by how far the two are apart at rest."""
    skin = (torso.surface.points.rest.numpy()[vertices] * share[..., None]).sum(1)
    apart = np.linalg.norm(rest - skin, axis=1)
    return _owed(apart, config.contact, config.groin_near, config.groin_far)


def _points(body: Body, rest: Float[Tensor, "V 3"], index: Int[np.ndarray, "N"]) -> Points:
    return Points(rest[index], body.pose_directions[:, index].contiguous(), body.weights[index])


def _surface(body: Body, rest: Float[Tensor, "V 3"], part: Part) -> Surface:
    points = torch.from_numpy(part.with_centres(rest.numpy()))
    directions = torch.from_numpy(part.with_centres(body.pose_directions.transpose(0, 1).numpy()))
    weights = torch.from_numpy(part.with_centres(body.weights.numpy()))
    normals = vertex_normals(points, torch.from_numpy(part.faces))  # of the closed part: its rim has two sides
    return Surface(Points(points, directions.transpose(0, 1).contiguous(), weights), normals.numpy())


def _faces_of(part: Part, chosen: Bool[Tensor, "V"]) -> Bool[np.ndarray, "F"]:
    """Faces of a part whose real corners are all chosen (caps never are)."""
    flags = np.concatenate([chosen.numpy()[part.vertices], np.zeros(len(part.rims), bool)])
    return np.all(flags[part.faces], axis=1)


def _spread(points: Float[np.ndarray, "N 3"], allowed: Bool[np.ndarray, "N"], count: int) -> Int[np.ndarray, "S"]:
    """Farthest-point samples among the allowed points."""
    index = np.flatnonzero(allowed)
    if len(index) <= count:
        return index
    cloud = points[index]
    chosen = [int(np.abs(cloud[:, 0]).argmax())]
    distance = ((cloud - cloud[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((cloud - cloud[chosen[-1]]) ** 2).sum(1))
    return index[np.array(chosen)]


def _check(motion: Motion, body: Body, betas: Tensor) -> None:
    if motion.skeleton.names != body.joint_names or motion.skeleton.parents != body.parents:
        raise ValueError(
            f"motion {motion.name!r} has {len(motion.skeleton)} joints of another skeleton than the "
            f"{len(body.parents)} of body '{body.name}'; retarget it first (workbench.formats.load_motion(path, body))"
        )
    if tuple(betas.shape) != (body.shape_count,):
        raise ValueError(
            f"betas must be one shape of {body.shape_count} components for body '{body.name}', "
            f"but have shape {tuple(betas.shape)}"
        )
    if not torch.isfinite(betas).all():
        raise ValueError("betas must be finite, but hold NaN or infinity")
