"""Scans: what is written is read back; other units, axes and damage are told apart, each by its own line."""

from typing import Any

import numpy as np
import pytest
import trimesh

from workbench.formats.scans import (
    PackedScan,
    Scan,
    estimate_normals,
    read_packed_scan,
    read_scan,
    write_packed_scan,
    write_scan,
)


def figure(rng, count=3000):
    """An ellipsoid of a person's size, standing: points and exact normals."""
    radii = np.array([0.3, 0.15, 0.85])
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normals = unit / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Scan((unit * radii + [0, 0, 0.9]).astype(np.float32), normals.astype(np.float32), "figure")


def bare_ply(path, points):
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in points.tolist())
    path.write_text(
        f"ply\nformat ascii 1.0\ncomment bare\nelement vertex {len(points)}\n"
        f"property float x\nproperty float y\nproperty float z\nend_header\n{rows}"
    )


def test_a_ply_returns_exactly(tmp_path, rng):
    scan = figure(rng)
    write_scan(tmp_path / "s.ply", scan)
    read = read_scan(tmp_path / "s.ply")
    np.testing.assert_array_equal(read.points, scan.points)
    np.testing.assert_allclose(read.normals, scan.normals, atol=1e-6)
    assert read.remarks == ()


def test_others_read_our_ply_and_we_read_theirs(tmp_path, rng):
    scan = figure(rng, 200)
    write_scan(tmp_path / "s.ply", scan)
    theirs: Any = trimesh.load(tmp_path / "s.ply", process=False)
    np.testing.assert_array_equal(np.asarray(theirs.vertices, np.float32), scan.points)
    trimesh.PointCloud(scan.points).export(tmp_path / "t.ply")
    np.testing.assert_allclose(read_scan(tmp_path / "t.ply").points, scan.points, atol=1e-6)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_a_mesh_is_sampled_evenly_on_its_surface(tmp_path, rng, suffix):
    mesh = trimesh.creation.box(extents=(0.4, 0.3, 1.7))
    mesh.export(tmp_path / f"m{suffix}")
    read = read_scan(tmp_path / f"m{suffix}", generator=rng, count=5000)
    assert len(read) == 5000
    assert np.abs(np.abs(read.points / [0.2, 0.15, 0.85]).max(1) - 1).max() < 1e-5
    assert (np.abs(read.normals).max(1) > 0.999).all()
    assert "5000 points were sampled" in read.remarks[0]


def test_missing_normals_are_estimated_and_said(tmp_path, rng):
    scan = figure(rng)
    bare_ply(tmp_path / "bare.ply", scan.points)
    read = read_scan(tmp_path / "bare.ply")
    angle = np.degrees(np.arccos(np.clip((read.normals * scan.normals).sum(1), -1, 1)))
    assert np.median(angle) < 3
    assert (angle < 30).mean() > 0.99  # outwards everywhere
    assert "bare.ply has no normals: they were estimated" in read.remarks[0]


def test_estimated_normals_are_exact_on_a_plane_and_turn_with_it(rng):
    flat = np.column_stack([rng.random((300, 2)), np.zeros(300)])
    np.testing.assert_allclose(np.abs(estimate_normals(flat)[:, 2]), 1, atol=1e-6)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    aligned = (estimate_normals(flat @ turn.T) * turn[:, 2]).sum(1)
    np.testing.assert_allclose(np.abs(aligned), 1, atol=1e-5)
    assert len(np.unique(np.sign(aligned))) == 1
    with pytest.raises(ValueError, match="cannot be estimated from 5 points"):
        estimate_normals(flat[:5])


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000.0), ("cm", 100.0)])
def test_other_units_are_detected_and_mended(tmp_path, rng, unit, scale):
    scan = figure(rng)
    write_scan(tmp_path / "s.ply", Scan(scan.points * np.float32(scale), scan.normals))
    with pytest.raises(ValueError, match=rf"s.ply is .* m large; it looks like {unit}: pass unit='{unit}'"):
        read_scan(tmp_path / "s.ply")
    np.testing.assert_allclose(read_scan(tmp_path / "s.ply", unit=unit).points, scan.points, atol=1e-5)


def test_y_up_is_detected_and_mended(tmp_path, rng):
    scan = figure(rng)
    lying = scan.points[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
    turned = scan.normals[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
    write_scan(tmp_path / "s.ply", Scan(lying, turned))
    with pytest.raises(ValueError, match=r"m deep \(y\); it looks y-up: pass up='y'"):
        read_scan(tmp_path / "s.ply")
    read = read_scan(tmp_path / "s.ply", up="y")
    np.testing.assert_allclose(read.points, scan.points, atol=1e-6)
    np.testing.assert_allclose(read.normals, scan.normals, atol=1e-6)


def test_what_is_no_person_is_refused(tmp_path, rng):
    scan = figure(rng)
    write_scan(tmp_path / "s.ply", Scan(scan.points * np.float32(5), scan.normals))
    with pytest.raises(ValueError, match="8.5 m large; expected a person"):
        read_scan(tmp_path / "s.ply")


def damaged(tmp_path, rng, how):
    path, scan = tmp_path / "s.ply", figure(rng, 50)
    if how == "nan":
        scan.points[7, 1] = np.nan
        write_scan(path, scan)
    elif how == "zero normals":
        scan.normals[3] = 0
        write_scan(path, scan)
    elif how == "empty":
        write_scan(path, Scan(scan.points[:0], scan.normals[:0]))
    elif how == "truncated":
        write_scan(path, scan)
        path.write_bytes(path.read_bytes()[:-100])
    elif how == "foreign":
        path.write_text("a diary")
    elif how == "no coordinates":
        path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n")
    elif how == "bad obj":
        path = tmp_path / "s.obj"
        path.write_text("v 0 0 x\n")
    elif how == "suffix":
        path = tmp_path / "s.xyz"
        path.write_text("0 0 0\n")
    return path


@pytest.mark.parametrize(
    ("how", "line"),
    [
        ("nan", "1 of 50 points are NaN or infinite; remove them"),
        ("zero normals", "1 normals are zero, NaN or infinite"),
        ("empty", "holds no points"),
        ("truncated", r"is damaged: \d+ bytes of vertices, expected 1200"),
        ("foreign", "is not a PLY file"),
        ("no coordinates", "its vertices have a; expected x, y, z"),
        ("bad obj", "is not a readable OBJ"),
        ("suffix", r"scans are read from .ply and .obj files, not .xyz"),
    ],
)
def test_each_damage_has_its_line(tmp_path, rng, how, line):
    with pytest.raises(ValueError, match=line):
        read_scan(damaged(tmp_path, rng, how))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no scan at .*nowhere.ply"):
        read_scan(tmp_path / "nowhere.ply")
    with pytest.raises(ValueError, match=r"written as .ply, not as s.obj"):
        write_scan(tmp_path / "s.obj", Scan(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)))


@pytest.fixture
def packed(rng):
    def real(*shape):
        return rng.normal(size=shape).astype(np.float32)

    return PackedScan(figure(rng, 40), real(9, 3), real(9, 3, 3), real(16, 16, 3), real(8, 8, 3))


def test_the_published_layout_returns_exactly(tmp_path, packed):
    write_packed_scan(tmp_path / "p.npz", packed)
    assert set(np.load(tmp_path / "p.npz").files) == {
        *("posmap16", "posmap_canonical8", "scan_pc", "scan_n", "scan_name", "body_verts", "vtransf")
    }
    read = read_packed_scan(tmp_path / "p.npz")
    for name in ("body_vertices", "transforms", "position_map", "canonical_map"):
        np.testing.assert_array_equal(getattr(read, name), getattr(packed, name))
    np.testing.assert_array_equal(read.scan.points, packed.scan.points)
    assert read.scan.name == "figure"


def test_4x4_transforms_give_their_rotation(tmp_path, packed):
    write_packed_scan(tmp_path / "p.npz", packed)
    arrays = dict(np.load(tmp_path / "p.npz"))
    arrays["vtransf"] = np.pad(arrays["vtransf"], ((0, 0), (0, 1), (0, 1)), constant_values=7)
    np.savez(tmp_path / "q.npz", **arrays)
    np.testing.assert_array_equal(read_packed_scan(tmp_path / "q.npz").transforms, packed.transforms)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"scan_n": np.zeros((3, 3))}, r"scan_n is float64 \(3, 3\), expected numbers of shape \(40, 3\)"),
        ({"body_verts": np.full((9, 3), np.nan)}, "body_verts holds NaN"),
        ({"posmap32": np.zeros((32, 32, 3))}, "expected one array posmap<size>, got posmap16, posmap32"),
        ({"scan_pc": np.zeros((0, 3))}, "scan_pc holds no points"),
        ({"scan_pc": None}, "it lacks scan_pc"),
    ],
)
def test_each_damage_of_the_layout_has_its_line(tmp_path, packed, change, line):
    write_packed_scan(tmp_path / "p.npz", packed)
    arrays = {**np.load(tmp_path / "p.npz"), **change}
    np.savez(tmp_path / "q.npz", **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(ValueError, match=line):
        read_packed_scan(tmp_path / "q.npz")
