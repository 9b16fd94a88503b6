"""MARDM's essential features: the part of HumanML3D's that positions are decoded from."""

from flame_mdm.representations.humanml import HumanML


class Essential(HumanML):
    """The first 67 of HumanML3D's 263 features (Meng et al. 2025, MARDM), 64 of KIT's 251, 3 J + 1 for J joints.

    `HumanML` describes the arguments and the columns.

    Example:
        >>> Essential().features, Essential(skeleton="kit21").features
        (67, 64)
    """

    essential = True
