"""Command lines that start several jobs: sweeps over the values of keys, and launchers."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from flame_mdm.config.command_line import (
    STOP,
    checked_settings,
    guarded,
    is_text,
    make_variables,
    run,
    with_keys,
)
from flame_mdm.config.composition import EXPERIMENTS, LAUNCH, choices, compose, parse, quoted
from flame_mdm.config.sweeps import SWEEP, check_launcher, hydra_sweep
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io.paths import check_tree

Settings = TypeVar("Settings")

FOLDER = Path("runs") / "sweeps"
"""Folder for the logs of the jobs that a launcher starts.

The results of a job are written to the same location as without a launcher.
"""


def run_jobs(command: Callable[[Settings], None], kind: type[Settings], argv: Sequence[str]) -> int:
    """Runs a command line `[OBJECT [OUT]] key=value ... [--multirun]` and returns the exit code.

    With `--multirun`, values separated by commas define a sweep with one job per combination, and
    the jobs run one after the other. `launch=...` passes the jobs of a sweep, or a single job, to a
    launcher and waits for them. Values of keys that accept any text, such as paths, are never
    split.
    """
    words = make_variables() if "--from-make" in argv else list(argv)
    asks_for_help = any(word in ("-h", "--help") for word in words)
    if asks_for_help or not any(word in SWEEP or word.startswith(f"{LAUNCH}=") for word in words):
        return run(command, kind, argv)
    codes = [0]
    return guarded(lambda: _serve(command, kind, words, codes), STOP) or max(codes)


def _serve(
    command: Callable[[Settings], None],
    kind: type[Settings],
    words: Sequence[str],
    codes: list[int],
) -> None:
    launcher = [word for word in words if _is_of_launcher(word)]
    keyed = with_keys(kind, [word for word in words if word not in launcher and word not in SWEEP])
    combinations = list(product(*(_alternatives(kind, word) for word in keyed)))
    jobs = [checked_settings(kind, list(combination)) for combination in combinations]
    out = vars(jobs[0]).get("out")
    if len(jobs) > 1 and out is not None:
        raise UserError(f"out={out}: {len(jobs)} jobs would write to this path. Remove out=")

    starts = [partial(guarded, partial(command, job), STOP) for job in jobs]
    if launcher:
        _launch(starts, launcher)
        return
    for number, start in enumerate(starts, 1):
        changed = " ".join(word for word in combinations[number - 1] if word not in keyed)
        say(f"job {number} of {len(starts)}: {changed}")
        codes.append(start())
        if codes[-1] > 128:  # a signal ends the entire sweep
            return


def _is_of_launcher(word: str) -> bool:
    return word.startswith((f"{LAUNCH}=", "hydra."))


def _alternatives(kind: type[Any], word: str) -> list[str]:
    """Splits a word that lists several values into words `key=value` with one value each."""
    key, separator, _ = word.partition("=")
    if not separator or is_text(kind, key):
        return [word]
    return [f"{key}={choice}" for choice in choices(parse([word])[0])]


def _launch(jobs: Sequence[Callable[[], int]], words: Sequence[str]) -> None:
    """Passes jobs to a Hydra launcher and waits for them.

    `words` select the launcher (`launch=NAME`) and set its keys.
    """
    compose("quickstart", words)  # checks the words
    launchers = [word.partition("=")[2] for word in words if word.startswith(f"{LAUNCH}=")]
    check_launcher(launchers)
    say(f"waiting for the jobs; their output is in {FOLDER}/.submitit")
    check_tree(FOLDER)  # Hydra and the launchers overwrite files in this folder in place

    def job(config: Any) -> None:
        if code := jobs[config["job"]]():
            raise SystemExit(code)

    numbers = ",".join(map(str, range(len(jobs))))
    chosen = [f"+{word}" if word.startswith(f"{LAUNCH}=") else word for word in words]
    output = [quoted(f"hydra.sweep.dir={FOLDER}"), "hydra.sweep.subdir=${job}"]
    hydra_sweep(job, EXPERIMENTS, None, [*output, *chosen, f"+job={numbers}"])
