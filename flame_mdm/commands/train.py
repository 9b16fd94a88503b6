"""`flame-mdm train NAME key=value ...`: trains an experiment, or resumes it."""

from functools import partial

from flame_mdm.config.sweeps import run_recipe
from flame_mdm.training.start import train

USAGE = """
usage: flame-mdm train NAME [key=value ...] [--multirun]

Trains the experiment NAME: a file in experiments/, or the path of a recipe or a saved config.yaml.
key=value overrides a single key, as in trainer.max_steps=1000, and part=name replaces a component,
as in denoiser=mdm_decoder. Running the same command again resumes the run; run.name=other starts
another run.
"""

main = partial(run_recipe, train, USAGE)
