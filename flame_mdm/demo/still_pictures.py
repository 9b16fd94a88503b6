"""Small pictures of actions for the page's buttons."""

from functools import cache
from pathlib import Path

from flame_mdm.conditions.language.tables import Value, actions
from flame_mdm.data.synthetic import example
from flame_mdm.data.synthetic_actions import ACTIONS, Attributes
from flame_mdm.formats.motion import Motion
from flame_mdm.visualize.render import thumbnail

STILLS = Path(__file__).parent / "stills"
"""Pictures of samples from the model "package", for actions that the synthetic set lacks."""


@cache
def still(action: str, side: Value | None = None) -> bytes | None:
    """Returns a WebP image of an action, or None if no picture of the action exists.

    Args:
        action: name of the action in `actions.yaml`.
        side: side of the body, for actions in the synthetic data set that can be done on either
            side. Default: any side.
    """
    names = [name for name in actions()[action].names if name in ACTIONS]
    if names:
        stated: Attributes = {"action": names[0]}
        if side is not None:
            stated["side"] = side
        return thumbnail(Motion(example(stated), 20.0))
    file = STILLS / f"{action}.webp"
    return file.read_bytes() if file.exists() else None
