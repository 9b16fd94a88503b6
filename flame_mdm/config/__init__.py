"""Configuration: recipes composed by Hydra, checked against the signatures of what they name, and saved as plain dicts.

Nothing here imports torch or Lightning, so that `--help` and a misspelt key answer at once.
"""

from flame_mdm.config.building import (
    RUN_DIR,
    TRUSTED,
    current_names,
    flatten,
    instantiate,
    movable,
    original_names,
    plain,
    read_saved,
    save,
    trust,
)
from flame_mdm.config.command_line import guarded, run
from flame_mdm.config.composition import EXPERIMENTS, compose, groups, recipes, settings
from flame_mdm.config.signatures import Config, check, parameters
