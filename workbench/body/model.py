"""Eq. 2-3: the parametric body M_B.  beta (K), theta (J,3,3) -> vertices (V,3)."""

from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.skeleton import Skeleton
from workbench.body.skinning import Pose, RigidTransforms, dual_quaternion, forward_kinematics, linear_blend
from workbench.npz import read_npz

Skinning = Literal["linear", "dual_quaternion"]

SMPL_JOINTS = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
)

REQUIRED_ARRAYS = (
    "name",
    "template",
    "shape_directions",
    "pose_directions",
    "pose_map",
    "weights",
    "joint_template",
    "joint_directions",
    "faces",
    "parents",
    "joint_names",
)


@dataclass(frozen=True)
class Body:
    """A linear body model: M_B(beta, theta) = W(T_b + B_s(beta) + B_p(theta), J(beta), theta, weights).

    theta is a local rotation matrix a joint; a posed point is sum_j w_j (R_j p + t_j), and the root joint goes to
    J_root(beta) + translation.  B_p is stored at low rank: B_p(theta) = (pose_feature @ pose_map) . pose_directions.
    Metres; z up, the body faces -y.
    """

    name: str
    template: Float[Tensor, "V 3"]
    shape_directions: Float[Tensor, "K V 3"]
    pose_directions: Float[Tensor, "P V 3"]
    pose_map: Float[Tensor, "Q P"]  # Q = 9 (J - 1)
    weights: Float[Tensor, "V J"]
    joint_template: Float[Tensor, "J 3"]
    joint_directions: Float[Tensor, "K J 3"]
    faces: Int[Tensor, "F 3"]
    parents: tuple[int, ...]
    joint_names: tuple[str, ...]
    uv: Float[Tensor, "U 2"] | None = None
    uv_faces: Int[Tensor, "F 3"] | None = None

    @property
    def skeleton(self) -> Skeleton:
        return Skeleton(names=self.joint_names, parents=self.parents, rest_joints=self.joint_template)

    @property
    def shape_count(self) -> int:
        return self.shape_directions.shape[0]

    @staticmethod
    def default() -> "Body":
        """The body that ships: 13,348 vertices, 31 joints, 10 shapes; baked by `python -m assets_gen body`."""
        return _default_body()

    @staticmethod
    def load(path: str | Path) -> "Body":
        """Read our own npz, or an SMPL-format npz or pkl (through a restricted unpickler).

        Errors: ValueError naming the file and what it lacks.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"no body file at {path}; pass our own .npz, or an SMPL-format .npz or .pkl")
        if path.suffix == ".npz":
            arrays = read_npz(path, "a body of ours or of SMPL format")
            if "pose_map" in arrays:
                return body_from_arrays(arrays)
        from workbench.formats.smpl import read_smpl  # heavy and rare

        return _from_smpl(read_smpl(path), name=path.stem)

    def save(self, path: str | Path) -> None:
        """Write our own npz: float32, and float16 for the dense displacement bases (error < 0.03 mm)."""
        arrays: dict[str, Any] = {
            "name": np.array(self.name),
            "template": self.template.numpy(),
            "shape_directions": self.shape_directions.numpy(),
            "pose_directions": self.pose_directions.numpy().astype(np.float16),
            "pose_map": self.pose_map.numpy(),
            "weights": self.weights.numpy(),
            "joint_template": self.joint_template.numpy(),
            "joint_directions": self.joint_directions.numpy(),
            "faces": self.faces.numpy().astype(np.int32),
            "parents": np.array(self.parents, dtype=np.int32),
            "joint_names": np.array(self.joint_names),
        }
        if self.uv is not None and self.uv_faces is not None:
            arrays |= {"uv": self.uv.numpy(), "uv_faces": self.uv_faces.numpy().astype(np.int32)}
        np.savez_compressed(path, **arrays)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Body":
        """The same body with its real arrays on another device or of another precision."""

        def moved(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=dtype if tensor.is_floating_point() else None)

        return replace(self, **{key: moved(value) for key, value in vars(self).items() if isinstance(value, Tensor)})

    # B_s, B_p and J of Eq. 3

    def shape_offsets(self, betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B V 3"]:
        """B_s(beta): the displacement of each vertex for a body shape, in metres."""
        self._check_betas(betas)
        return torch.einsum("...k,kvi->...vi", betas, self.shape_directions)

    def pose_feature(self, rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B Q"]:
        """R - I of every joint but the root, flattened: what B_p is linear in."""
        self._check_rotations(rotations)
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        return (rotations[..., 1:, :, :] - identity).flatten(-3)

    def pose_coefficients(self, rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B P"]:
        """The weights of pose_directions for a pose."""
        return self.pose_feature(rotations) @ self.pose_map

    def pose_offsets(self, rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B V 3"]:
        """B_p(theta): the correction of each vertex for a pose, in rest space, in metres."""
        return torch.einsum("...p,pvi->...vi", self.pose_coefficients(rotations), self.pose_directions)

    def joints(self, betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B J 3"]:
        """J(beta): rest joints of a shape, in metres."""
        self._check_betas(betas)
        return self.joint_template + torch.einsum("...k,kji->...ji", betas, self.joint_directions)

    def pose(
        self,
        rotations: Float[Tensor, "*R J 3 3"],
        betas: Float[Tensor, "*S K"],
        translation: Float[Tensor, "*T 3"] | None = None,
    ) -> Pose:
        """The skeleton of a shape in a pose; leading axes broadcast."""
        self._check_rotations(rotations)
        joints = self.joints(betas)
        batch = torch.broadcast_shapes(rotations.shape[:-3], joints.shape[:-2])
        posed = forward_kinematics(
            rotations.expand(*batch, *rotations.shape[-3:]), joints.expand(*batch, *joints.shape[-2:]), self.parents
        )
        if translation is None:
            return posed
        shift = translation[..., None, :]
        transforms = RigidTransforms(posed.transforms.rotation, posed.transforms.translation + shift)
        return Pose(transforms, posed.joints + shift)

    def unposed(self, rotations: Float[Tensor, "*R J 3 3"], betas: Float[Tensor, "*S K"]) -> Float[Tensor, "*B V 3"]:
        """T_b(beta, theta) = T_b + B_s(beta) + B_p(theta)      (Eq. 3)"""
        return self.template + self.shape_offsets(betas) + self.pose_offsets(rotations)

    def vertices(
        self,
        rotations: Float[Tensor, "*R J 3 3"],
        betas: Float[Tensor, "*S K"],
        translation: Float[Tensor, "*T 3"] | None = None,
        *,
        skinning: Skinning = "linear",
    ) -> Float[Tensor, "*B V 3"]:
        """M_B(beta, theta): the posed body (Eq. 2).  Leading axes broadcast; differentiable in all three.

        The correctives B_p are fitted to linear blending: dual-quaternion skinning leaves them out.
        """
        transforms = self.pose(rotations, betas, translation).transforms
        if skinning == "linear":
            return linear_blend(self.unposed(rotations, betas), self.weights, transforms)
        if skinning == "dual_quaternion":
            return dual_quaternion(self.template + self.shape_offsets(betas), self.weights, transforms)
        raise ValueError(f"skinning is {skinning!r}; expected 'linear' or 'dual_quaternion'")

    def rest_rotations(self) -> Float[Tensor, "J 3 3"]:
        """theta = 0: the identity for every joint."""
        return torch.eye(3, dtype=self.template.dtype, device=self.template.device).repeat(len(self.parents), 1, 1)

    def mean_shape(self) -> Float[Tensor, "K"]:
        """beta = 0."""
        return self.template.new_zeros(self.shape_count)

    def _check_betas(self, betas: Tensor) -> None:
        if betas.shape[-1] != self.shape_count:
            raise ValueError(f"betas have {betas.shape[-1]} components, but body '{self.name}' has {self.shape_count}")

    def _check_rotations(self, rotations: Tensor) -> None:
        if rotations.shape[-3] != len(self.parents):
            raise ValueError(
                f"the pose has {rotations.shape[-3]} joints, but body '{self.name}' has {len(self.parents)}; "
                "retarget the motion onto this skeleton first (workbench.formats.load_motion)"
            )


def body_from_arrays(arrays: dict[str, np.ndarray]) -> Body:
    """Build a body from numpy arrays named as the fields of `Body` (as stored on disk).

    Errors: ValueError naming the first array that is missing, misshapen, not finite or inconsistent.
    """
    _check_arrays(arrays)

    def real(key: str) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(arrays[key], dtype=np.float32))

    def whole(key: str) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(arrays[key], dtype=np.int64))

    return Body(
        name=str(arrays["name"]),
        template=real("template"),
        shape_directions=real("shape_directions"),
        pose_directions=real("pose_directions"),
        pose_map=real("pose_map"),
        weights=real("weights"),
        joint_template=real("joint_template"),
        joint_directions=real("joint_directions"),
        faces=whole("faces"),
        parents=tuple(int(p) for p in arrays["parents"]),
        joint_names=tuple(str(n) for n in arrays["joint_names"]),
        uv=real("uv") if "uv" in arrays else None,
        uv_faces=whole("uv_faces") if "uv_faces" in arrays else None,
    )


@cache
def _default_body() -> Body:
    with resources.as_file(resources.files("workbench") / "assets" / "body" / "default.npz") as path:
        return _read_own(path)


def _read_own(path: Path) -> Body:
    return body_from_arrays(read_npz(path, "a body"))


def _from_smpl(smpl: Any, name: str) -> Body:
    """SMPL's arrays (Loper et al. 2015) in our terms: its 9(J-1) pose blendshapes are the pose directions."""
    vertices, joints = smpl.weights.shape
    pose_count = 9 * (joints - 1)
    regressor = smpl.joint_regressor
    shape_directions = np.moveaxis(smpl.shape_directions, -1, 0)
    names = [*SMPL_JOINTS[:joints]] + [f"joint_{index}" for index in range(len(SMPL_JOINTS), joints)]
    return body_from_arrays(
        {
            "name": np.array(name),
            "template": smpl.template,
            "shape_directions": shape_directions,
            "pose_directions": np.moveaxis(smpl.pose_directions, -1, 0)[:pose_count].reshape(pose_count, vertices, 3),
            "pose_map": np.eye(pose_count),
            "weights": smpl.weights,
            "joint_template": regressor @ smpl.template,
            "joint_directions": np.einsum("jv,kvi->kji", regressor, shape_directions),
            "faces": smpl.faces,
            "parents": smpl.parents,
            "joint_names": np.array(names),
        }
    )


def _check_arrays(arrays: dict[str, np.ndarray]) -> None:
    name = f"body '{arrays.get('name', '?')}'"
    missing = [key for key in REQUIRED_ARRAYS if key not in arrays]
    if missing:
        raise ValueError(f"{name} lacks {', '.join(missing)}; it holds {', '.join(sorted(arrays))}")
    vertex_count, joint_count = arrays["weights"].shape
    shape_count, pose_count = len(arrays["shape_directions"]), len(arrays["pose_directions"])
    expected = {
        "template": (vertex_count, 3),
        "shape_directions": (shape_count, vertex_count, 3),
        "pose_directions": (pose_count, vertex_count, 3),
        "pose_map": (9 * (joint_count - 1), pose_count),
        "joint_template": (joint_count, 3),
        "joint_directions": (shape_count, joint_count, 3),
        "parents": (joint_count,),
        "joint_names": (joint_count,),
    }
    for key, shape in expected.items():
        if arrays[key].shape != shape:
            raise ValueError(f"{name}: {key} has shape {arrays[key].shape}, expected {shape}")
        if arrays[key].dtype.kind == "f" and not np.isfinite(arrays[key]).all():
            raise ValueError(f"{name}: {key} holds NaN or infinity; the file is damaged")
    if any(parent >= joint for joint, parent in enumerate(arrays["parents"])):
        raise ValueError(f"{name}: a joint comes before its parent; sort the joints root first")
    faces = arrays["faces"]
    if faces.max() >= vertex_count or faces.min() < 0:
        raise ValueError(f"{name}: faces index vertex {faces.max()}, but the mesh has {vertex_count} vertices")
    sums = arrays["weights"].sum(axis=1)
    worst = int(np.abs(sums - 1).argmax())
    if abs(sums[worst] - 1) > 1e-3:
        raise ValueError(f"{name}: skinning weights of vertex {worst} sum to {sums[worst]:.3f}, expected 1")
