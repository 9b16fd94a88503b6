"""Text- and action-conditioned human motion generation with FLAME, MDM and Motion Flow Matching.

import flame_mdm
model = flame_mdm.load("runs/quickstart/default")
motion = flame_mdm.generate(model, "a person waves with the left hand", seconds=3, seed=0)[0]
motion.joints  # (F, J, 3) meters, y up
motion.save("wave.glb")
"""

import os
from typing import TYPE_CHECKING, Any

__version__ = "0.3.0"

# This must be set before torch is imported. It limits how long a thread that waits for other
# threads spins before it sleeps. The default is so long that a training step takes three to twenty
# times as long when other programs use the cores. Without any spinning, a second thread would bring
# no speedup.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")

if TYPE_CHECKING:
    from flame_mdm.checkpoints.loading import load
    from flame_mdm.formats.motion import Motion
    from flame_mdm.generator import MotionGenerator as MotionGenerator
    from flame_mdm.sampling.editing import edit
    from flame_mdm.sampling.generation import generate
    from flame_mdm.sampling.referee.judging import judge
    from flame_mdm.sampling.streams import stream
    from flame_mdm.training.adaptation import adapt

__all__ = ["Motion", "adapt", "edit", "generate", "judge", "load", "stream"]

_MODULES = {
    "adapt": "training.adaptation",
    "load": "checkpoints.loading",
    "MotionGenerator": "generator",
    "generate": "sampling.generation",
    "Motion": "formats.motion",
    "edit": "sampling.editing",
    "stream": "sampling.streams",
    "judge": "sampling.referee.judging",
}


def __getattr__(name: str) -> Any:
    """Imports public names on first use, so that `--help` does not import torch."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
