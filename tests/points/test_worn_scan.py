"""Scan files with their bodies: every way in gives the same cloud in the pelvis frame; what cannot be used is told."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from workbench.body.skeleton import Skeleton
from workbench.formats.scans import PackedScan, Scan, write_packed_scan, write_scan
from workbench.geometry.mesh import vertex_normals
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.uv_position_map import pelvis_frame, posed_bodies
from workbench.points.worn_scan import ScanSource, betas_from_words, read_worn_scan, require_aligned, world_scan

WORDS = "0.5,-1"


@pytest.fixture(scope="module")
def worn(body):
    """A body grown by 1 cm, turned and moved in the world: (rotations, translation, betas, local scan)."""
    generator = torch.Generator().manual_seed(4)
    rotations = axis_angle_to_matrix(0.2 * torch.randn(1, len(body.parents), 3, generator=generator))
    rotations[:, 0] = axis_angle_to_matrix(torch.tensor([[0.1, 0.05, 2.0]]))
    betas = betas_from_words(WORDS, body)
    vertices = posed_bodies(body, rotations, betas).vertices[0]
    normals = vertex_normals(vertices, body.faces)
    return rotations, torch.tensor([0.4, -0.2, 0.1]), betas, ScanFrame(vertices + 0.01 * normals, normals)


@pytest.fixture(scope="module")
def files(body, worn, tmp_path_factory):
    """The scan as .ply in the world and as a sequence; the pose as a motion."""
    folder = tmp_path_factory.mktemp("worn")
    rotations, translation, betas, scan = worn
    frame = pelvis_frame(body, rotations[0], betas, translation)
    world = Scan(frame.to_world(scan.points).numpy(), (scan.normals @ frame.rotation.mT).numpy())
    write_scan(folder / "s.ply", world)
    skeleton = Skeleton(body.joint_names, body.parents, body.joint_template)
    Motion(rotations, translation[None], 30.0, skeleton, "pose").save(folder / "pose.npz")
    ScanSequence.of([scan], outfit="skin", motion="m", rotations=rotations, betas=betas, fps=30.0).save(
        folder / "s.npz"
    )
    return folder


def source(files, **changes):
    return replace(ScanSource(files / "s.ply", pose=files / "pose.npz", betas=WORDS), **changes)


def test_every_way_in_gives_the_same_cloud(files, body, worn):
    from_ply, from_npz = read_worn_scan(source(files), body), read_worn_scan(ScanSource(files / "s.npz"), body)
    for read in (from_ply, from_npz):
        torch.testing.assert_close(read.scan.points, worn[3].points, atol=1e-4, rtol=0)
        torch.testing.assert_close(read.scan.normals, worn[3].normals, atol=2e-2, rtol=0)
        assert torch.equal(read.betas, worn[2])
        torch.testing.assert_close(read.bodies.vertices, from_npz.bodies.vertices, atol=1e-5, rtol=0)
    assert from_ply.remarks == ()


def test_back_in_the_world_it_is_the_file(files, body):
    read = read_worn_scan(source(files), body)
    again = world_scan(read, read.scan)
    write_scan(files / "again.ply", again)
    torch.testing.assert_close(
        read_worn_scan(source(files, file=files / "again.ply"), body).scan.points, read.scan.points, atol=1e-5, rtol=0
    )


def test_a_scan_that_stands_elsewhere_is_told_how_to_move(files, body, worn):
    read = read_worn_scan(source(files), body)
    away = world_scan(read, ScanFrame(read.scan.points + torch.tensor([0.7, 0.0, -0.3]), read.scan.normals))
    write_scan(files / "away.ply", away)
    with pytest.raises(ValueError, match=r"lies \d+ cm off the scan .*: with --place it would lie \d"):
        read_worn_scan(source(files, file=files / "away.ply"), body)
    placed = read_worn_scan(source(files, file=files / "away.ply", place=True), body)
    assert (placed.scan.points - worn[3].points).norm(dim=1).median() < 0.02


def test_estimated_normals_are_told(files, body):
    points = read_worn_scan(source(files), body)
    world = world_scan(points, points.scan).points[::4]
    (files / "bare.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in world))
    read = read_worn_scan(source(files, file=files / "bare.obj"), body)
    assert "has no normals: they were estimated" in read.remarks[0]
    agreement = (read.scan.normals * points.scan.normals[::4]).sum(1)
    assert (agreement > 0).float().mean() > 0.9  # 3,337 points; what is left is fingers and toes


def test_units_axes_and_nan_are_told(files, body):
    world = world_scan(read_worn_scan(source(files), body), read_worn_scan(source(files), body).scan)
    write_scan(files / "mm.ply", Scan(world.points * 1000, world.normals))
    with pytest.raises(ValueError, match="unit='mm'"):
        read_worn_scan(source(files, file=files / "mm.ply"), body)
    assert len(read_worn_scan(source(files, file=files / "mm.ply", unit="mm"), body).scan.points)
    swapped = world.points[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
    write_scan(files / "y.ply", Scan(swapped, world.normals))
    with pytest.raises(ValueError, match=r"with --up y it would lie \d\.\d cm off"):
        read_worn_scan(source(files, file=files / "y.ply"), body)
    broken = world.points.copy()
    broken[3] = np.nan
    write_scan(files / "nan.ply", Scan(broken, world.normals))
    with pytest.raises(ValueError, match="1 of 13348 points are NaN or infinite"):
        read_worn_scan(source(files, file=files / "nan.ply"), body)
    write_scan(files / "few.ply", Scan(world.points[::100], world.normals[::100]))
    with pytest.raises(ValueError, match="the scan has 134 points; expected thousands"):
        read_worn_scan(source(files, file=files / "few.ply"), body)


def test_frames_shapes_and_bodies_are_checked(files, body, worn):
    with pytest.raises(ValueError, match=r"s.npz has 1 scans, counted from 0; got --frame 3"):
        read_worn_scan(ScanSource(files / "s.npz", frame=3), body)
    with pytest.raises(ValueError, match=r"pose.npz has 1 frames, counted from 0; got --frame 3"):
        read_worn_scan(source(files, frame=3), body)
    with pytest.raises(ValueError, match="has its pose and shape with it: leave out --pose and --betas"):
        read_worn_scan(ScanSource(files / "s.npz", betas="1"), body)
    with pytest.raises(ValueError, match="must be numbers with commas"):
        betas_from_words("tall", body)
    with pytest.raises(ValueError, match="11 betas given"):
        betas_from_words("1," * 11, body)
    with pytest.raises(ValueError, match="holds NaN"):
        betas_from_words("nan", body)
    with pytest.raises(ValueError, match="a scan has one body, got 2"):
        require_aligned(worn[3], posed_bodies(body, worn[0].repeat(2, 1, 1, 1), worn[2]))


def test_a_published_scan_is_told_its_body_is_another(files, body):
    points = np.zeros((5, 3), np.float32)
    image = np.zeros((4, 4, 3), np.float32)
    write_packed_scan(
        files / "p.npz", PackedScan(Scan(points, points), points, np.zeros((5, 3, 3), np.float32), image, image)
    )
    with pytest.raises(ValueError, match="packed scan of the published data, whose body is of another family"):
        read_worn_scan(ScanSource(files / "p.npz"), body)
