"""A motion of a person standing still. By default, streams start with this motion."""

import numpy as np
from torch import Tensor

from flame_mdm.data.synthetic_motions.body import Body
from flame_mdm.formats.conversion import raw_motion
from flame_mdm.formats.motion import Motion
from flame_mdm.representations import Representation
from flame_mdm.representations.skeleton import SMPL22


def standing(representation: Representation, frames: int) -> Motion:
    """Returns a motion of a person standing still, with its features in a representation.

    The motion is generated like the motions of the synthetic data set, so no data is required.
    """
    # Some representations have one row per pair of neighboring frames, so one frame is added.
    body = Body(np.random.default_rng(0), np.zeros(frames + 1))
    still = Motion(body.joints(), representation.fps, SMPL22, "a person stands still", "standing")
    features: Tensor = representation.encode(raw_motion(still, representation).values)[:frames]
    return Motion(
        representation.decode(features).numpy(),
        representation.fps,
        representation.skeleton,
        still.text,
        still.id,
        features=features.numpy(),
        representation=representation.name,
    )
