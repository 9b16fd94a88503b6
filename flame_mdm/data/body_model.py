"""The rest pose of SMPL from its licensed model file, which users download at https://smpl.is.tue.mpg.de."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix

from flame_mdm.data import restricted_pickle
from flame_mdm.representations.skeleton import SMPL24
from flame_mdm.safe_io import naming, read_npz

Offsets = tuple[tuple[float, float, float], ...]


def load_offsets(path: Path) -> Offsets:
    """Returns the position of SMPL's 24 joints relative to their parents in the rest pose of the mean shape, meters.

    The first is the pelvis relative to the origin. `path` is SMPL's .pkl as downloaded, of which no code runs, or an
    .npz with the same arrays.
    """
    with naming(path, KeyError, TypeError, IndexError, ValueError, what="not a SMPL model of 24 joints: "):
        if path.suffix == ".npz":
            model: Any = read_npz(path, only=("J_regressor", "v_template", "kintree_table"))
        else:
            model = restricted_pickle.read(path, opaque=("chumpy.", "scipy.sparse."))
        regressor, template = model["J_regressor"], model["v_template"]
        if isinstance(regressor, dict):  # the state of a sparse matrix
            parts = (regressor[name] for name in ("data", "indices", "indptr"))
            regressor = csc_matrix(tuple(parts), shape=regressor["_shape"]).toarray()
        if isinstance(template, dict):  # the state of an array of chumpy
            template = template["x"]
        regressor, template = np.asarray(regressor, np.float64), np.asarray(template, np.float64)
        parents = np.asarray(model["kintree_table"])[0, 1:].tolist()
        if regressor.shape != (24, len(template)) or template.shape[1:] != (3,) or parents != list(SMPL24.parents[1:]):
            raise ValueError(f"J_regressor {regressor.shape}, v_template {template.shape}, or another tree of joints")
        joints = regressor @ template
        if not np.isfinite(joints).all():
            raise ValueError("non-finite numbers")
    offsets = joints - np.concatenate([np.zeros((1, 3)), joints[list(SMPL24.parents[1:])]])
    return tuple(tuple(offset) for offset in offsets.tolist())
