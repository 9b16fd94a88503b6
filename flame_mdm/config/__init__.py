"""Configuration: command lines, recipes composed by Hydra, signature checks and instantiation.

These modules import neither torch nor Lightning, so that `--help` and errors about misspelled keys
appear immediately.
"""

from flame_mdm.config.building import (
    EXPERIMENTS,
    flatten,
    instantiate,
    movable,
    moved,
    plain,
    read_saved,
    renamed,
    save,
    trust,
)
from flame_mdm.config.command_line import guarded, run
from flame_mdm.config.composition import compose, compose_data, groups, recipes
from flame_mdm.config.signatures import Config, check, parameters
