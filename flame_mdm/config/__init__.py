"""Configuration: command lines, recipes composed by Hydra, checks against signatures, instantiation.

Nothing here imports torch or Lightning, so that `--help` and errors about misspelled keys are immediate.
"""

from flame_mdm.config.building import RUN_DIR, flatten, instantiate, movable, moved, plain, read_saved, save
from flame_mdm.config.command_line import run
from flame_mdm.config.composition import EXPERIMENTS, compose, compose_data, groups, recipes
from flame_mdm.config.entry import guarded
from flame_mdm.config.signatures import Config, check, parameters
from flame_mdm.config.trust import foreign, trust
