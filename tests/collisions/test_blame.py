"""Blame: faults planted in every stage come back with the stage's name; what a stage mends is not its predecessor's."""

from dataclasses import dataclass

import pytest
import torch
import trimesh
from torch import Tensor

from workbench.collisions.blame import BODY_OVERLAP, CAUSES, FREE, STAGES, StageArrays, blame, blame_report
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.planting import dent
from workbench.collisions.projection import ProjectionConfig, Projector, fixed_point
from workbench.collisions.sequences import shipped_sequence
from workbench.garments import Garment
from workbench.geometry.mesh import unique_edges
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.strain import rest_triangles
from workbench.geometry.winding import winding_number

FRAMES = 4


@pytest.fixture(scope="module")
def ball() -> tuple[Tensor, Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).long()


def at_radii(*radii: float) -> Tensor:
    """One frame of vertices on a line; inside the ball where the radius is below 1."""
    return torch.tensor([[[radius, 0.01, 0.02] for radius in radii]])


def test_the_stage_after_which_a_vertex_is_first_inside(ball):
    vertices, faces = ball
    stages = StageArrays(
        faces,
        simulated=at_radii(0.5, 2, 2, 2, 2, 2),
        simulated_body=vertices[None],
        canonical_body=vertices,
        projected=at_radii(0.5, 0.5, 2, 2, 2, 2),
        decoded=at_radii(0.5, 0.5, 0.5, 2, 2, 2),
        regressed=at_radii(0.5, 0.5, 0.5, 0.5, 2, 2),
        posed=at_radii(0.5, 0.5, 0.5, 0.5, 0.5, 2),
        posed_body=vertices[None],
    )
    found = blame(stages)
    assert [CAUSES[c] for c in found.cause[0, :5].tolist()] == list(STAGES)
    assert found.cause[0, 5] == FREE
    assert found.counts == dict.fromkeys(STAGES, 1) | {BODY_OVERLAP: 0}
    assert sum(found.mended.values()) == 0


def test_a_mended_fault_is_not_blamed_for_a_later_one(ball):
    vertices, faces = ball
    stages = StageArrays(
        faces,
        canonical_body=vertices,
        projected=at_radii(0.5, 0.5),
        decoded=at_radii(2, 2),
        regressed=at_radii(0.5, 2),
    )
    found = blame(stages)
    assert found.counts == {"projection": 0, "decoder": 0, "regressor": 1, BODY_OVERLAP: 0}
    assert found.mended == {"projection": 2, "decoder": 0}


@pytest.mark.parametrize("last", ["projected", "decoded", "regressed"])
def test_any_one_stage_is_enough(ball, last):
    vertices, faces = ball
    found = blame(StageArrays(faces, canonical_body=vertices, **{last: at_radii(0.5, 2)}))  # pyright: ignore[reportArgumentType]
    assert sum(found.counts.values()) == 1
    report = blame_report(found)
    assert report["colliding"] == 1
    assert sorted(report["by_cause_percent"].values()) == [0, 100]


def test_two_layers_of_the_body_are_the_bodys_fault(ball):
    vertices, faces = ball
    both = torch.cat([vertices, vertices + torch.tensor([1.0, 0, 0])])
    stages = StageArrays(torch.cat([faces, faces + len(vertices)]), posed=at_radii(-0.5, 0.5, 3), posed_body=both[None])
    assert blame(stages).counts == {"unprojection": 1, BODY_OVERLAP: 1}


def test_cloth_on_skin_that_is_buried_is_the_bodys_fault(ball):
    """A vertex above the first ball, in one layer only: that of the second ball, which has swallowed its skin."""
    vertices, faces = ball
    pair = torch.cat([faces, faces + len(vertices)])
    apart = torch.cat([vertices, vertices + torch.tensor([5.0, 0, 0])])
    swallowed = torch.cat([vertices, vertices + torch.tensor([1.5, 0, 0])])
    cloth = at_radii(1.05, -0.9)
    stages = StageArrays(
        pair, canonical_body=apart, regressed=at_radii(1.05, -1.05), posed=cloth, posed_body=swallowed[None]
    )
    assert blame(stages).counts == {"regressor": 0, "unprojection": 1, BODY_OVERLAP: 1}


def test_what_cannot_be_blamed_is_refused(ball):
    vertices, faces = ball
    with pytest.raises(ValueError, match="there is no stage to blame: give the garment after at least one of simul"):
        StageArrays(faces)
    with pytest.raises(ValueError, match="the body is missing for decoder"):
        StageArrays(faces, decoded=at_radii(2))
    with pytest.raises(ValueError, match=r"same frames and vertices, got projection \(1, 1, 3\), decoder \(1, 2, 3\)"):
        StageArrays(faces, canonical_body=vertices, projected=at_radii(2), decoded=at_radii(2, 2))


# --- planted faults on real cloth


@dataclass(frozen=True)
class Clean:
    """A real simulation and its canonical garment, on the wearer's body, before anything is planted."""

    model: GarmentModel
    simulated: Tensor
    simulated_body: Tensor
    states: list
    X: Tensor
    posed_states: list
    posed_body: Tensor
    edges: Tensor


@pytest.fixture(scope="module")
def clean(body) -> Clean:
    sequence = shipped_sequence("tshirt_demo").clip(20, 20 + FRAMES)
    model = GarmentModel(body, GridFields.default())
    states = [model.state(r, sequence.betas, t) for r, t in zip(sequence.rotations, sequence.translation)]
    garment = Garment.load("tshirt")
    rest = rest_triangles(garment.rest_vertices, garment.faces)
    projector = Projector(model, GridSDF.default(), rest, garment.vertices)
    X = projector.project(sequence.garment, model.state(sequence.rotations, sequence.betas, sequence.translation))
    with torch.no_grad():
        wearer = torch.zeros(body.shape_count)
        wearer[:2] = torch.tensor([0.6, -0.5])
        rotations = sequence.rotations.clone()
        # in the last frame the wearer's arm goes through the torso
        rotations[-1, body.joint_names.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 0.8, 0.0]))
        posed_states = [model.state(r, wearer, t) for r, t in zip(rotations, sequence.translation)]
        return Clean(
            model,
            sequence.garment,
            body.vertices(sequence.rotations, sequence.betas, sequence.translation),
            states,
            X.canonical,
            posed_states,
            body.vertices(rotations, wearer, sequence.translation),
            unique_edges(sequence.faces),
        )


@pytest.mark.parametrize("seed", range(5))
def test_planted_faults_are_blamed_on_their_stage(clean, body, seed):
    """One dent in each stage, at other places for each seed, carried through all later stages as a real fault is; and
    an arm through the torso.  At least 95 % of the colliding vertices must be blamed on what was done to them."""
    generator = torch.Generator().manual_seed(seed)
    template, faces = body.template, body.faces
    centres = torch.randperm(clean.X.shape[1], generator=generator)[:5].tolist()
    planted = {name: torch.zeros(clean.X.shape[:2], dtype=torch.bool) for name in STAGES}

    def with_dent(name: str, garment: Tensor, bodies: Tensor) -> Tensor:
        made = [
            dent(frame, clean.edges, surface, faces, centres[STAGES.index(name)], rings=4)
            for frame, surface in zip(garment, bodies.expand(FRAMES, -1, -1))
        ]
        for frame, one in enumerate(made):
            planted[name][frame, one.patch] = True
        return torch.stack([one.garment for one in made])

    with torch.no_grad():
        simulated = with_dent("simulation data", clean.simulated, clean.simulated_body)
        X = torch.stack(
            [
                fixed_point(clean.model, M_G, state, start, ProjectionConfig())[0]
                for M_G, state, start in zip(simulated, clean.states, clean.X)
            ]
        )
        projected = with_dent("projection", X, template[None])
        decoded = with_dent("decoder", projected, template[None])
        regressed = with_dent("regressor", decoded, template[None])
        posed = torch.stack([clean.model.posed(X, state) for X, state in zip(regressed, clean.posed_states)])
        posed = with_dent("unprojection", posed, clean.posed_body)
    stages = StageArrays(
        faces, simulated, clean.simulated_body, template, projected, decoded, regressed, posed, clean.posed_body
    )
    found = blame(stages)

    truth = torch.full(found.cause.shape, STAGES.index("unprojection"))
    truth[-1, on_buried_skin(clean, body, regressed[-1])] = CAUSES.index(BODY_OVERLAP)
    for name in reversed(STAGES[:-1]):  # where dents meet, the earliest stage is to blame
        truth[planted[name]] = STAGES.index(name)
    colliding = found.cause != FREE
    for name in STAGES:
        assert (planted[name] & colliding).sum() > 40, name
    assert ((truth == CAUSES.index(BODY_OVERLAP)) & colliding).sum() > 20
    right = (found.cause == truth)[colliding].float().mean()
    assert right >= 0.95, f"{right:.3f}; {found.counts}"


def on_buried_skin(clean: Clean, body, X: Tensor) -> Tensor:
    """Vertices whose nearest skin VERTEX lies in two layers of the pressed body, by the sum over all faces."""
    nearest = torch.cdist(X, body.template).argmin(1)
    used, which = torch.unique(nearest, return_inverse=True)
    surface = clean.posed_body[-1]
    normals = torch.from_numpy(trimesh.Trimesh(surface, body.faces, process=False).vertex_normals.copy()).float()
    above = surface[used] + 1e-3 * normals[used]
    return torch.from_numpy(winding_number(above.numpy(), surface.numpy(), body.faces.numpy()) > 0.5)[which]
