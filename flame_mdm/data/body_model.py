"""Rest poses of SMPL and SMPL+H.

The poses are read from licensed model files, which users must download.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csc_matrix

from flame_mdm.data import restricted_pickle
from flame_mdm.data.amass import Recording
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22, SMPL24, forward_kinematics
from flame_mdm.safe_io import naming, read_npz

ARRAYS = ("J_regressor", "v_template", "kintree_table", "shapedirs")


def load_offsets(path: Path) -> tuple[tuple[float, float, float], ...]:
    """Returns the positions of SMPL's 24 joints relative to their parents, in meters.

    The offsets are taken from the mean body shape in the rest pose.

    Args:
        path: SMPL's .pkl from https://smpl.is.tue.mpg.de, or an .npz file with the same arrays.
            No code in the .pkl is run.
    """
    with naming(
        path,
        KeyError,
        TypeError,
        IndexError,
        ValueError,
        prefix="not an SMPL model with 24 joints: ",
    ):
        if path.suffix == ".npz":
            model: Any = read_npz(path, only=ARRAYS)
        else:
            model = restricted_pickle.read(path, opaque=("chumpy.", "scipy.sparse."))
        regressor, template = model["J_regressor"], model["v_template"]
        if isinstance(regressor, dict):  # the state of a sparse matrix
            parts = (regressor[name] for name in ("data", "indices", "indptr"))
            regressor = csc_matrix(tuple(parts), shape=regressor["_shape"]).toarray()
        if isinstance(template, dict):  # the state of a chumpy array
            template = template["x"]
        joints = _rest_joints(regressor, template, model["kintree_table"], 24, SMPL24.parents)
    offsets = joints - np.concatenate([np.zeros((1, 3)), joints[list(SMPL24.parents[1:])]])
    return tuple(tuple(offset) for offset in offsets.tolist())


def _rest_joints(
    regressor: Any, vertices: Any, tree: Any, joints: int, parents: tuple[int, ...]
) -> np.ndarray:
    """Returns the rest positions (J, 3) of a model's joints.

    Raises:
        ValueError: If the parents of the model's first joints are not `parents`.
    """
    regressor, vertices = np.asarray(regressor, np.float64), np.asarray(vertices, np.float64)
    numbers = np.asarray(tree)[0, 1 : len(parents)].tolist()
    if (
        regressor.shape != (joints, len(vertices))
        or vertices.shape[1:] != (3,)
        or numbers != list(parents[1:])
    ):
        raise ValueError(
            f"J_regressor has shape {regressor.shape}, v_template has shape {vertices.shape}, or the "
            "kinematic tree differs"
        )
    rest = regressor @ vertices
    if not np.isfinite(rest).all():
        raise ValueError("it contains non-finite numbers")
    return rest


class Body(NamedTuple):
    """Rest positions of SMPL+H's first 22 joints, in meters, as a function of the body's shape.

    Args:
        rest: (22, 3), joint positions of the mean shape.
        shape: (22, 3, 10), displacement of the joints per unit of each beta.
    """

    rest: torch.Tensor
    shape: torch.Tensor

    def joints(self, recording: Recording) -> np.ndarray:
        """Returns the joint positions (F, 22, 3) float64 of a recording, in meters.

        As in HumanML3D, y is up: AMASS's coordinates (x, y, z) become (-x, z, y).
        """
        betas = torch.from_numpy(recording.betas[:10].astype(np.float64))
        rest = self.rest + self.shape[..., : len(betas)] @ betas
        poses = torch.from_numpy(recording.poses[:, :66].astype(np.float64)).unflatten(1, (22, 3))
        root = torch.from_numpy(recording.translation.astype(np.float64)) + rest[0]
        turned = rotation.axis_angle_to_matrix(poses)
        joints = forward_kinematics(SMPL22, turned, SMPL22.bones(rest), root)
        return (joints[..., [0, 2, 1]] * joints.new_tensor([-1.0, 1.0, 1.0])).numpy()


def load_body(folder: Path, gender: str) -> Body:
    """Loads the extended SMPL+H model for a gender.

    For "male", the file is `male/model.npz` or `SMPLH_MALE.npz`, in the folder or in its subfolder
    `smplh`.
    """
    names = (f"{gender}/model.npz", f"SMPLH_{gender.upper()}.npz")
    candidates = [folder / inner / name for inner in ("", "smplh") for name in names]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        get_it = "download the extended SMPL+H model from https://mano.is.tue.mpg.de"
        raise FileNotFoundError(f"{folder}: contains neither {' nor '.join(names)}; {get_it}")
    with naming(
        path,
        KeyError,
        TypeError,
        IndexError,
        ValueError,
        prefix="not an SMPL+H model with 52 joints: ",
    ):
        regressor, template, tree, directions = (
            read_npz(path, only=ARRAYS)[name] for name in ARRAYS
        )
        rest = _rest_joints(regressor, template, tree, 52, SMPL22.parents)[:22]
        shape = np.einsum(
            "jv,vck->jck",
            regressor[:22].astype(np.float64),
            directions[..., :10].astype(np.float64),
        )
    return Body(torch.from_numpy(rest), torch.from_numpy(shape))
