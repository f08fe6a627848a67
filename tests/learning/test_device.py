"""Training on another device: each stage runs there, ends where the CPU ends, and leaves nothing behind on the CPU.

There is no GPU here.  A stand-in takes its place: tensors that say they are on `meta`, hold real numbers, and refuse to
meet one of the CPU, as those of a GPU do (more strictly: torch lets a GPU's tensor be indexed by the CPU's).
"""

from contextlib import contextmanager, nullcontext
from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

from workbench import cli
from workbench.collisions import field_training, regressor, subspace
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.canonical_set import CanonicalSequence, CanonicalSet
from workbench.collisions.field_training import PoolConfig, TrainFieldsConfig
from workbench.collisions.regressor import TrainRegressorConfig
from workbench.collisions.subspace import NetworkConfig, Statistics, Subspace, TrainSubspaceConfig
from workbench.garments import Garment
from workbench.geometry.chamfer import NearestPoint, nearest_by_all_distances
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning import device as device_module
from workbench.learning.batches import random_rows
from workbench.learning.device import device_named
from workbench.learning.fit import FitConfig, fit
from workbench.learning.mlp import MLP
from workbench.learning.network_file import read_network
from workbench.learning.parallel import Processes, processes
from workbench.points import training, training_run
from workbench.points.clothed_points import PointModelConfig
from workbench.points.geometry_features import GeometryFeaturesConfig
from workbench.points.patches import PatchModelConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.training import PointTrainingConfig, autocast
from workbench.points.training_run import TrainPointsConfig
from workbench.points.uv_position_map import posed_bodies

aten = torch.ops.aten
ELSEWHERE = torch.device("meta")
FEW = FitConfig(steps=4, warmup=1, checkpoint_every=2)
NETWORK = NetworkConfig(width=16, depth=1, rank=30)


class Elsewhere(torch.Tensor):
    """A tensor of the CPU that says it is on ELSEWHERE."""

    inner: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    @staticmethod
    def __new__(cls, inner):
        place = {}
        if inner.layout == torch.strided:
            place = {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), dtype=inner.dtype, layout=inner.layout, device=ELSEWHERE, **place
        )
        made.inner = inner
        return made

    def __tensor_flatten__(self):  # by this nn.Module.to knows that it must swap, not assign
        return ["inner"], None

    @staticmethod
    def __tensor_unflatten__(parts, _context, _size, _stride):
        return Elsewhere(parts["inner"])

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise AssertionError(f"{func} on a tensor from elsewhere, outside of `elsewhere()`")


class _Kernels(TorchDispatchMode):
    """Computes with what the tensors hold; refuses operands of two devices, and double precision as mps does."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        there = any(isinstance(tensor, Elsewhere) for tensor in tensors)
        left_behind = [t for t in tensors if not isinstance(t, Elsewhere) and t.dim()]  # 0-d ones may meet any
        if there and left_behind and func is not aten.copy_.default:
            raise RuntimeError(f"{func}: an operand of shape {tuple(left_behind[0].shape)} is still on the CPU")
        asked = kwargs.get("device")
        if asked is not None:
            there = torch.device(asked) == ELSEWHERE
            kwargs["device"] = torch.device("cpu")
        if func is aten.copy_.default:
            there = isinstance(args[0], Elsewhere)
        bare_args, bare_kwargs = tree_map_only(Elsewhere, lambda tensor: tensor.inner, (args, kwargs))
        out = func(*bare_args, **bare_kwargs)
        if not there:
            return out
        if any(t.dtype == torch.float64 for t in tree_leaves(out) if isinstance(t, torch.Tensor)):
            raise RuntimeError(f"{func}: float64 is not to be had on mps")
        wrapped = tree_map_only(torch.Tensor, Elsewhere, out)
        meets = any(isinstance(tensor, Elsewhere) for tensor in tensors)
        return return_and_correct_aliasing(func, args, kwargs, wrapped) if meets else wrapped


def _literal(numbers, *, device="cpu", tensor=torch.tensor, **options):
    """`torch.tensor` that keeps its numbers elsewhere, where torch itself would make an empty one."""
    return tensor(numbers, **options).to(device)


@contextmanager
def elsewhere():
    with pytest.MonkeyPatch.context() as patch, _Kernels():
        patch.setattr(device_module, "devices", lambda: ["cpu", str(ELSEWHERE)])
        patch.setattr(torch, "tensor", _literal)
        yield


# The stand-in


def test_the_stand_in_notices_what_was_left_behind():
    with elsewhere():
        x = torch.rand(4, 3).to(ELSEWHERE)
        assert (x @ x.mT).device == ELSEWHERE
        assert torch.equal(x[x[:, 0] >= 0].cpu(), x.cpu())
        for forgotten in (
            lambda: x + torch.eye(4, 3),
            lambda: x[torch.tensor([0, 1])],
            lambda: torch.nn.Linear(3, 2)(x),
            lambda: torch.cat([x, torch.zeros(1, 3)]),
            lambda: torch.where(x > 0, x, torch.zeros(4, 3)),
        ):
            with pytest.raises(RuntimeError, match="is still on the CPU"):
                forgotten()
        with pytest.raises(RuntimeError, match="numpy"):
            x.numpy()
        with pytest.raises(RuntimeError, match="float64"):
            x.double()


# Names


@pytest.mark.parametrize("stage", ["fields", "subspace", "regressor", "points"])
def test_a_device_that_is_not_there_is_refused_in_one_line(stage, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(device_module, "devices", lambda: ["cpu"])
    assert cli.main(["train", stage, "--out", str(tmp_path), "--device", "cuda"]) == cli.UNUSABLE
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("workbench: there is no device 'cuda' here: torch sees cpu only; ")
    assert not list(tmp_path.iterdir())


def test_devices_by_name(monkeypatch):
    current = []
    monkeypatch.setattr(device_module, "devices", lambda: ["cpu", "cuda:0", "cuda:1", "mps"])
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    names = ("cpu", "mps", "cuda", "cuda:1")
    assert [str(device_named(name)) for name in names] == ["cpu", "mps", "cuda:0", "cuda:1"]
    assert [str(device) for device in current] == ["cuda:0", "cuda:1"]
    for name in ("cuda:2", "gpu", "", "cpu:0"):
        with pytest.raises(ValueError, match=f"no device '{name}' here: torch sees cpu, cuda:0, cuda:1, mps; "):
            device_named(name)


def test_under_torchrun_each_process_takes_its_own_gpu(monkeypatch):
    monkeypatch.setattr(device_module, "devices", lambda: ["cpu", "cuda:0", "cuda:1", "mps"])
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    monkeypatch.setenv("WORLD_SIZE", "3")
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert [str(device_named(name)) for name in ("cpu", "cuda")] == ["cpu", "cuda:1"]
    for shared in ("cuda:0", "mps"):
        with pytest.raises(ValueError, match=f"cannot share device '{shared}'.*give cuda"):
            device_named(shared)
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(ValueError, match="no device 'cuda:2' here"):
        device_named("cuda")


def test_this_machine_has_the_cpu():
    assert device_module.devices()[0] == "cpu"
    assert device_named("cpu") == torch.device("cpu")


# Pieces


def test_a_batch_is_the_same_on_every_device():
    rows = torch.rand(50, 2)
    here = random_rows(rows, 9, torch.Generator().manual_seed(3))
    with elsewhere():
        there = random_rows(rows.to(ELSEWHERE), 9, torch.Generator().manual_seed(3))
        assert there.device == ELSEWHERE
        assert torch.equal(there.cpu(), here)


def test_neighbours_by_all_distances_are_as_near_as_the_trees(rng):
    x, y = (torch.from_numpy(rng.normal(size=(count, 3))).float() for count in (300, 400))
    by_tree, by_all = NearestPoint(y.numpy())(x.numpy()), nearest_by_all_distances(x, y)
    torch.testing.assert_close((x - y[by_all]).norm(dim=1), (x - y[by_tree]).norm(dim=1), atol=1e-6, rtol=0)


def test_the_distance_of_the_table_and_its_gradient_are_the_same_elsewhere(body, rng):
    points = body.template[::40] + torch.from_numpy(rng.normal(size=(len(body.template[::40]), 3))).float() * 0.05
    sdf, here = GridSDF.default(), points.clone().requires_grad_()
    sdf(here).sum().backward()
    with elsewhere():
        there = points.to(ELSEWHERE).requires_grad_()
        sdf.to(ELSEWHERE)(there).sum().backward()
        torch.testing.assert_close(there.grad.cpu(), here.grad, atol=1e-4, rtol=1e-4)  # pyright: ignore[reportOptionalMemberAccess]


def test_half_precision_is_that_of_the_device():
    assert [autocast("float32", torch.device(name)).device for name in ("cpu", "cuda")] == ["cpu", "cuda"]


def test_processes_with_gpus_talk_over_nccl_and_their_generators_over_gloo(monkeypatch):
    begun = []
    monkeypatch.setenv("WORLD_SIZE", "2")
    for name, answer in {
        "is_initialized": False,
        "is_nccl_available": True,
        "get_rank": 0,
        "get_world_size": 2,
    }.items():
        monkeypatch.setattr(torch.distributed, name, lambda answer=answer: answer)
    monkeypatch.setattr(torch.distributed, "init_process_group", begun.append)
    for gpus in (True, False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda gpus=gpus: gpus)
        assert processes() == Processes(0, 2)
    assert begun == ["cpu:gloo,cuda:nccl", "gloo"]


# The loop


class Killed(Exception):
    pass


def regression(device, checkpoint=None, *, stop_at=None):
    """A small regression on a device; what it ends with, on the CPU."""
    network = MLP(1, 1, width=8, depth=2, generator=torch.Generator().manual_seed(0)).to(device)

    def loss_of(step, generator):
        if step == stop_at:
            raise Killed
        x = torch.rand(16, 1, generator=generator).to(device)
        return (network(x) - torch.sin(6 * x)).square().mean()

    fit(
        list(network.parameters()),
        loss_of,
        FitConfig(steps=12, learning_rate=1e-2, warmup=2, checkpoint_every=4),
        generator=torch.Generator().manual_seed(1),
        checkpoint=checkpoint,
    )
    return [parameter.detach().cpu() for parameter in network.parameters()]


@pytest.mark.parametrize("begins_here", [True, False])
def test_a_run_begun_on_one_device_continues_on_another(begins_here, tmp_path):
    whole = regression("cpu")
    with elsewhere():
        first, second = ("cpu", ELSEWHERE) if begins_here else (ELSEWHERE, "cpu")
        with pytest.raises(Killed):
            regression(first, tmp_path / "fit.safetensors", stop_at=7)
        resumed = regression(second, tmp_path / "fit.safetensors")
    assert all(torch.equal(a, b) for a, b in zip(whole, resumed, strict=True))


# The stages


def ends_alike(here, there, **tolerance):
    assert here.keys() == there.keys()
    for name, tensor in here.items():
        assert there[name].device.type == "cpu", name
        torch.testing.assert_close(there[name], tensor, msg=lambda text, name=name: f"{name}: {text}", **tolerance)


def test_fields_train_elsewhere(tmp_path):
    config = TrainFieldsConfig(
        out=tmp_path / "here",
        batch=64,
        pool=PoolConfig(points=200, samples=8),
        weights=FEW,
        shape=FEW,
        pose=FEW,
        sdf=FEW,
        sdf_batch=64,
        sdf_points=200,
    )
    here = field_training.run(config)
    with elsewhere():
        there = field_training.run(replace(config, out=tmp_path / "there", device=str(ELSEWHERE)))
    for name, network in here.fields.networks().items():
        ends_alike(network.state_dict(), there.fields.networks()[name].state_dict(), atol=0, rtol=0)
    ends_alike(here.sdf.network.state_dict(), there.sdf.network.state_dict(), atol=0, rtol=0)
    for file in ("weights", "shape", "pose", "sdf"):
        written = [read_network(tmp_path / place / f"{file}.safetensors", "") for place in ("here", "there")]
        assert written[0].metadata == written[1].metadata
        ends_alike(written[0].tensors, written[1].tensors, atol=0, rtol=0)


@pytest.fixture(scope="module")
def garments(body, tmp_path_factory):
    """A made-up training set of T-shirts, and a subspace of it."""
    folder = tmp_path_factory.mktemp("garments")
    template, chance = Garment.load("tshirt").vertices, torch.Generator().manual_seed(0)
    smooth = torch.sin(template[None] * torch.rand(30, 1, 3, generator=chance) * 9)
    basis = torch.linalg.qr(smooth.flatten(1).T).Q.T.unflatten(1, (-1, 3)) * len(template) ** 0.5

    def sequence(split):
        return CanonicalSequence(
            coefficients=0.002 * torch.randn(14, 30, generator=chance).cumsum(0),
            rotations=axis_angle_to_matrix(0.03 * torch.randn(14, len(body.parents), 3, generator=chance).cumsum(0)),
            translation=0.01 * torch.randn(14, 3, generator=chance).cumsum(0),
            betas=torch.randn(10, generator=chance),
            valid=torch.rand(14, generator=chance) > 0.1,
            motion_name="walk",
            split=split,
        )

    made = CanonicalSet("tshirt", template, basis, (sequence("train"), sequence("validation")), 30.0, 1e-4)
    made.save(folder / "set.npz")
    made = CanonicalSet.load(folder / "set.npz")
    Subspace("tshirt", Statistics.of(made, NETWORK), NETWORK).save(folder / "tshirt-subspace.safetensors")
    return folder


@pytest.mark.parametrize("rank", [30, 0], ids=["components", "dense"])
def test_a_subspace_trains_elsewhere(rank, garments, tmp_path):
    config = TrainSubspaceConfig(
        data=garments / "set.npz",
        out=tmp_path / "here",
        network=replace(NETWORK, rank=rank),
        batch=3,
        random_batch=2,
        fit=FEW,
        watch_every=2,
    )
    here = subspace.run(config)
    with elsewhere():
        there = subspace.run(replace(config, out=tmp_path / "there", device=str(ELSEWHERE)))
    ends_alike(here.state_dict(), there.state_dict(), atol=1e-5, rtol=1e-4)  # the table is read by torch, not by Warp
    for a, b in zip(here.story["curves"], there.story["curves"], strict=True):
        assert b == pytest.approx(a, rel=1e-3, abs=1e-3)


def test_a_regressor_trains_elsewhere(garments, tmp_path):
    config = TrainRegressorConfig(
        data=garments / "set.npz", out=garments, window=6, batch=2, describe=FEW, fit=FEW, watch_every=2, seed=3
    )  # of four seeds the first leaves one weight's gradient so near to zero that Adam makes 1.9e-5 of its rounding
    here = regressor.run(config)
    for file in (garments / "work").rglob("*.*"):
        file.unlink()
    with elsewhere():
        there = regressor.run(replace(config, device=str(ELSEWHERE)))
    ends_alike(here.state_dict(), there.state_dict(), atol=1e-5, rtol=1e-4)
    assert there.story["curves"][-1] == pytest.approx(here.story["curves"][-1], rel=1e-4)


@pytest.mark.parametrize("method", ["pop", "patches"])
def test_points_train_elsewhere(method, body, tmp_path, monkeypatch):
    encoder = PoseEncoderConfig(depth=4, width=4, features=6)
    pop = PointModelConfig(encoder, GeometryFeaturesConfig(16, 5), ShapeDecoderConfig(24, 11), 32)
    patches = PatchModelConfig(replace(encoder, depth=3), ShapeDecoderConfig(24, 8), 16, 2)
    monkeypatch.setattr(training_run, "TWO_CORES", pop)
    monkeypatch.setattr(training_run, "TWO_CORES_PATCHES", patches)
    autocasts = []  # torch knows none for the stand-in
    monkeypatch.setattr(training, "autocast", lambda *asked: autocasts.append(asked) or nullcontext())
    rotations = body.rest_rotations().repeat(2, 1, 1, 1)
    points = posed_bodies(body, rotations, body.mean_shape()).vertices[:, ::10]
    frames = [ScanFrame(p, torch.nn.functional.normalize(p, dim=-1)) for p in points]
    for outfit in ("dress", "tshirt")[: 2 if method == "pop" else 1]:
        scans = ScanSequence.of(
            frames, outfit=outfit, motion="walk", rotations=rotations, betas=body.mean_shape(), fps=30.0
        )
        scans.save(tmp_path / "scans" / f"{outfit}.npz")
    few = replace(FEW, steps=2)
    small = PointTrainingConfig(fit=few, queries=150, scan_points=200, calibration=1, query_size=32)
    config = TrainPointsConfig(data=tmp_path / "scans", out=tmp_path / "here", method=method, training=small)
    (here,) = training_run.run(config)
    with elsewhere():
        (there,) = training_run.run(replace(config, out=tmp_path / "there", device=str(ELSEWHERE)))
    assert [device for _, device in autocasts] == 2 * [torch.device("cpu")] + 2 * [ELSEWHERE]
    found = [read_network(path, "") for path in (here, there)]
    ends_alike(found[0].tensors, found[1].tensors, atol=1e-4, rtol=1e-3)
