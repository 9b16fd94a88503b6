"""Configuration: composition of recipes by Hydra, checks against signatures, instantiation, saving and loading.

Nothing here imports torch or Lightning, so that `--help` and errors about misspelled keys are immediate.
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
