"""MARDM's essential features: the HumanML3D features that determine the joint positions."""

from flame_mdm.representations.humanml import HumanML


class Essential(HumanML):
    """The first 67 of HumanML3D's 263 features (Meng et al. 2025, MARDM).

    For KIT, the features are the first 64 of its 251 features. For J joints, there are 3 J + 1
    features. `HumanML` describes the arguments and the columns.

    Example:
        >>> Essential().features, Essential(skeleton="kit21").features
        (67, 64)
    """

    essential = True
