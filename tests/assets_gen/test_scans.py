"""Scans of simulated clothes: only the outside, evenly, where it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from assets_gen.scans import ScansConfig, run, scan_sequence, scan_surfaces, sphere_directions
from workbench.collisions.sequences import SHIPPED, SimulatedSequence
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint
from workbench.points.uv_position_map import pelvis_frame, posed_bodies


def arrays(mesh):
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)


def tube(radius, low, high, sections=64):
    """An open cylinder with outward normals."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    vertices = np.concatenate([np.column_stack([ring, np.full(sections, z)]) for z in (low, high)])
    i, j = np.arange(sections), np.roll(np.arange(sections), -1)
    faces = [np.stack([i, j, sections + j], 1), np.stack([i, sections + j, sections + i], 1)]
    return vertices.astype(np.float32), np.concatenate(faces)


def test_directions_cover_the_sphere():
    directions = sphere_directions(96)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(directions.T @ directions / 96, np.eye(3) / 3, atol=0.01)
    np.testing.assert_allclose(directions.mean(0), 0, atol=0.02)


def test_what_is_wrapped_is_never_seen(rng):
    inner, outer = (arrays(trimesh.creation.icosphere(subdivisions=3, radius=r)) for r in (0.20, 0.205))
    scan = scan_surfaces([inner[0], outer[0]], [inner[1], outer[1]], 5000, rng)
    radius = scan.points.norm(dim=1).numpy()
    assert radius.min() > 0.202
    assert len(scan.points) == 5000


def test_a_convex_body_is_seen_whole_and_evenly(rng):
    box = trimesh.creation.box(extents=(0.4, 0.3, 1.6))
    scan = scan_surfaces([arrays(box)[0]], [arrays(box)[1]], 20_000, rng)
    area = 2 * np.array([0.3 * 1.6, 0.4 * 1.6, 0.4 * 0.3])
    share = (scan.normals.abs() > 0.9).float().mean(0).numpy()
    np.testing.assert_allclose(share, area / area.sum(), atol=0.015)
    assert (scan.normals[:, 2] < -0.9).float().mean() > 0.03  # the underside too: nothing hides it


def test_a_leg_in_a_skirt_is_seen_below_the_hem_only(rng):
    leg = trimesh.creation.cylinder(radius=0.06, height=0.9)
    leg.apply_translation([0, 0, 0.45])
    torso = trimesh.creation.cylinder(radius=0.2, height=0.4)
    torso.apply_translation([0, 0, 1.1])
    parts = [arrays(leg), arrays(torso), tube(0.16, 0.4, 0.899)]
    scan = scan_surfaces([vertices for vertices, _ in parts], [faces for _, faces in parts], 20_000, rng)
    below = scan.points[:, 2].numpy() < 0.89
    on_leg = below & (np.linalg.norm(scan.points[:, :2].numpy(), axis=1) < 0.061)
    side = on_leg & (np.abs(scan.normals[:, 2].numpy()) < 0.5)
    assert scan.points[side, 2].max() < 0.40 + 0.12  # a look past the hem, no steeper than 30 degrees, goes 0.06 m up
    assert scan.points[side, 2].min() < 0.01
    assert (scan.points[below & ~on_leg, 2] > 0.39).all()


def test_points_lie_on_the_surfaces_with_their_normals(body, rng):
    garment = Garment.load("tshirt")
    parts = [body.template.numpy(), garment.vertices.numpy()]
    scan = scan_surfaces(parts, [body.faces.numpy(), garment.faces.numpy()], 4000, rng)
    on_body, on_cloth = (
        ClosestPoint(part, faces.numpy()).query(scan.points.numpy())
        for part, faces in zip(parts, (body.faces, garment.faces), strict=True)
    )
    assert np.minimum(on_body.distance, on_cloth.distance).max() < 1e-5
    # the T-shirt hides the torso: body points that lie close under cloth are gone
    cloth = on_cloth.distance < 1e-4
    belly = np.abs(scan.points.numpy() - [0, -0.12, 1.1]).max(1) < 0.08
    assert belly.sum() > 50
    assert cloth[belly].all()


def test_scans_of_a_sequence_stand_in_the_pelvis_frame(body):
    """Each point lies on the simulated cloth or on the posed body, both carried into the pelvis frame."""
    sequence = SimulatedSequence.load(SHIPPED / "tshirt_walk.npz").clip(0, 20)
    scans = scan_sequence(sequence, body, ScansConfig(points=1500, stride=10))
    assert (len(scans), scans.outfit, scans.fps) == (2, "tshirt", 3.0)
    bodies = posed_bodies(body, scans.rotations, scans.betas)
    frame = pelvis_frame(body, sequence.rotations[10], sequence.betas, sequence.translation[10])
    scan = scans.frame(1).points.numpy()
    surfaces = [(bodies.vertices[1], body.faces), (frame.to_local(sequence.garment[10]), sequence.faces)]
    distance = [ClosestPoint(v.numpy(), f.numpy()).query(scan).distance for v, f in surfaces]
    assert np.minimum(*distance).max() < 1e-4
    assert (distance[1] < 1e-4).mean() > 0.2


def test_what_cannot_be_scanned_is_named(tmp_path, body):
    with pytest.raises(ValueError, match=r"no simulated sequence \*.npz in"):
        run(ScansConfig(sequences=tmp_path))
    with pytest.raises(ValueError, match="no simulated sequence nobody in"):
        run(ScansConfig(only=("nobody",)))
    sequence = SimulatedSequence.load(SHIPPED / "tshirt_walk.npz").clip(0, 2)
    with pytest.raises(ValueError, match="no frame of tshirt on .* was kept"):
        scan_sequence(replace(sequence, valid=torch.zeros(2, dtype=torch.bool)), body, ScansConfig())


def test_meshes_that_are_inside_out_are_refused(rng):
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions=2, radius=0.3))
    with pytest.raises(ValueError, match=r"only \d+ of \d+ surface points are visible"):
        scan_surfaces([vertices], [faces[:, ::-1]], 500, rng)
