"""The corrective as ONNX.  rotations (J,3,3), betas (1,K), latent (1,L) -> C (N,3), metres, canonical space.

The skeleton and what its patches see are part of the graph: who runs it needs the pose of a frame and nothing else.
"""

from typing import Any

import numpy as np
import torch

from workbench.collisions.limb_sight import FAR
from workbench.collisions.posed_corrective import FEATURE_SCALE, MILLI, REACH, PosedCorrective
from workbench.collisions.subspace import LATENTS
from workbench.learning.onnx_graph import Graph


class Writer:
    """A graph whose nodes name their own outputs."""

    def __init__(self) -> None:
        self.graph, self.count = Graph(), 0

    def __call__(self, operator: str, *inputs: Any, **attributes: Any) -> str:
        """A node; inputs that are no names become constants."""
        names = [one if isinstance(one, str) else self.constant(one) for one in inputs]
        return self.graph.node(operator, names, [self.name()], **attributes)

    def constant(self, value: Any) -> str:
        array = value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
        return self.graph.constant(self.name(), array.astype(np.float32) if array.dtype == np.float64 else array)

    def name(self) -> str:
        self.count += 1
        return f"v{self.count}"


def corrective_graph(corrective: PosedCorrective) -> Any:
    """`PosedCorrective.forward` of one frame."""
    write = Writer()
    offset = _mixed(write, corrective, _amounts(write, corrective, _seen(write, corrective)))
    size = write("ReduceMean", write("ReduceSum", write("Mul", offset, offset), np.array([1])), np.array([0]))
    reached = write("Sqrt", write("Max", size, np.float32(REACH**2)))
    write.graph.node("Mul", [offset, write("Div", np.float32(REACH), reached)], ["C"])
    given = {"rotations": [corrective.joints, 3, 3], "betas": [1, corrective.shapes], "latent": [1, LATENTS]}
    return write.graph.model("corrective", given, {"C": [corrective.vertex_count, 3]})


def _seen(write: Writer, corrective: PosedCorrective) -> str:
    """`LimbSight.forward`: (P,F)"""
    sight, count = corrective.sight, len(corrective.patches)
    joints = write("Reshape", write("Gemm", "betas", sight.joint_directions, sight.joints), np.array([-1, 3]))
    anchors = write("Reshape", write("Gemm", "betas", sight.offsets, sight.anchors), np.array([-1, 3, 1]))
    world, places = [], []
    for joint, parent in enumerate(sight.parents):
        place = write("Gather", joints, np.array(joint))
        if parent < 0:
            world.append(write.constant(np.eye(3, dtype=np.float32)))  # how the body is turned does not matter
            places.append(place)
            continue
        bone = write("Sub", place, write("Gather", joints, np.array(parent)))
        world.append(write("MatMul", world[parent], write("Gather", "rotations", np.array(joint))))
        places.append(write("Add", places[parent], write("MatMul", world[parent], bone)))
    columns = np.array([0])
    turns = write("Concat", *(write("Unsqueeze", one, columns) for one in world), axis=0)
    ends_at = write("Concat", *(write("Unsqueeze", one, columns) for one in places), axis=0)
    turned = write("Squeeze", write("MatMul", turns, write("Unsqueeze", joints, np.array([2]))), np.array([2]))
    weights = write.constant(sight.weights)
    A = write("MatMul", weights, write("Reshape", turns, np.array([-1, 9])))
    A = write("Reshape", A, np.array([count, 3, 3]))
    t = write("MatMul", weights, write("Sub", ends_at, turned))
    posed = write("Add", write("Squeeze", write("MatMul", A, anchors), np.array([2])), t)
    starts, ends = (bone.numpy() for bone in sight.bones())
    first = write("Gather", ends_at, starts)
    along = write("Sub", write("Gather", ends_at, ends), first)
    to = write("Sub", write("Unsqueeze", posed, np.array([1])), first)
    length = write("ReduceSum", write("Mul", along, along), np.array([1]), keepdims=0)
    share = write("Div", write("ReduceSum", write("Mul", to, along), np.array([2]), keepdims=0), length)
    share = write("Unsqueeze", write("Clip", share, np.float32(0), np.float32(1)), np.array([2]))
    apart = write("Sub", write("Mul", share, along), to)
    square = write("ReduceSum", write("Mul", apart, apart), np.array([2]))
    near = write("Exp", write("Mul", square, np.float32(-0.5 / FAR**2)))
    to_own = write("Unsqueeze", write("Transpose", A, perm=[0, 2, 1]), np.array([1]))
    own = write("MatMul", to_own, write("Unsqueeze", write("Gather", turns, starts), np.array([0])))
    own = write("Reshape", write("Sub", own, np.eye(3, dtype=np.float32)), np.array([count, len(starts), 9]))
    way = write("Div", write("MatMul", apart, A), np.float32(FAR))
    one = np.ones((count, len(starts), 1), np.float32)
    told = write("Mul", near, write("Concat", one, way, own, axis=2))
    return write("Reshape", told, np.array([count, sight.size]))


def _amounts(write: Writer, corrective: PosedCorrective, seen: str) -> str:
    """The shared layers: (P,1,R)"""
    size = corrective.sight.size
    of_all = write("Mul", write("Concat", "betas", "latent", axis=1), np.float32(FEATURE_SCALE))
    hidden = write("MatMul", seen, corrective.first[:size])
    hidden = write("Add", hidden, write("MatMul", of_all, corrective.first[size:]))
    hidden = _rectified(write, hidden, corrective.first_own, corrective.first_norm)
    hidden = write("MatMul", hidden, corrective.second)
    hidden = _rectified(write, hidden, corrective.second_own, corrective.second_norm)
    amounts = write("MatMul", write("Unsqueeze", hidden, np.array([1])), corrective.last)
    return write("Add", amounts, corrective.last_own[:, None])


def _rectified(write: Writer, hidden: str, own: torch.Tensor, norm: torch.nn.LayerNorm) -> str:
    positive = write("Relu", write("Add", hidden, own))
    return write("LayerNormalization", positive, norm.weight, norm.bias, axis=-1, epsilon=norm.eps)


def _mixed(write: Writer, corrective: PosedCorrective, amounts: str) -> str:
    """`PosedCorrective.mixed` in metres: (N,3)"""
    patches = corrective.patches
    basis = corrective.basis.unflatten(1, (len(patches), -1)).transpose(0, 1)
    values = write("Reshape", write("MatMul", amounts, basis), np.array([-1, 3]))
    weighed = write("Mul", values, patches.windows.reshape(-1, 1) / MILLI)
    still = np.zeros((patches.point_count, 3), np.float32)
    return write("ScatterND", still, patches.vertices.reshape(-1, 1).numpy(), weighed, reduction="add")
