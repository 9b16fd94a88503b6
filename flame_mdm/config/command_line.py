"""Command lines: parsing, composition by Hydra, sweeps and exit codes."""

from __future__ import annotations

import os
import re
import shlex
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from hydra import main as hydra_main
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from flame_mdm import errors
from flame_mdm.config.building import plain
from flame_mdm.config.composition import (
    EXPERIMENTS,
    LAUNCH,
    Recipe,
    find_recipe,
    first_choice,
    groups,
    parse,
    plan_composition,
    recipes,
    resolve,
)
from flame_mdm.config.signatures import Config, check, check_kind
from flame_mdm.errors import UserError, first_line, say

FLAGS = ("--help", "--multirun", "-m", "--cfg", "--resolve", "--package")
"""Hydra's options that all commands accept."""

NO_MEMORY = re.compile("allocate memory|out of memory|bad_alloc|start new thread|create a primitive|failed to map")
"""Messages of errors caused by a lack of memory: from torch, from threads, and from libraries that fail to load."""


def run(
    command: Callable[[Config], None],
    argv: Sequence[str],
    *,
    usage: str,
    name: str | None = None,
    objects: Sequence[str] = (),
    text: Sequence[str] = (),
    kinds: Mapping[str, str] | None = None,
    rewrite: Callable[[Sequence[str]], Sequence[str]] = list,
) -> int:
    """Runs a command line `[OBJECT [OUT]] key=value ...` through Hydra and returns the exit code.

    Args:
        command: does the work, given the resolved configuration.
        argv: the words after the command. Hydra's flags (`--multirun`, `--cfg job`) are passed on. `launch=...` passes
            each job of a sweep, or the only job, to that launcher, and waits for them.
        usage: printed for `--help`.
        name: the command's configuration; None = the first word names a recipe.
        objects: keys of the leading words that have no key, in this order; a key that ends with `*` takes all remaining
            words.
        text: keys whose values are taken literally, not parsed with Hydra's grammar.
        rewrite: replaces the words, all `key=value`, before they are composed.
        kinds: annotations of keys whose values are checked, such as `{"seconds": "float"}`; null is always legal.
    """
    words = _make_variables() if "--from-make" in argv else list(argv)
    if (not words and name is None) or any(word in ("-h", "--help") for word in words):
        say(*usage.strip().splitlines())
        if name is None:
            say("", "experiments:")
            for folder, names in groupby(recipes(), lambda recipe: recipe.rpartition("/")[0]):
                say(
                    f"  {folder + '/':13}{', '.join(name.rpartition('/')[2] for name in names)}".replace("  / ", "    ")
                )
            say("parts: " + ", ".join(f"{group}=..." for group in groups()))
        return 0 if words else 2
    codes = [0]

    def serve() -> None:
        keyed = words if name is None else rewrite(_with_keys(words, objects))
        _serve(command, [_quoted(word, text) for word in keyed], name, codes, kinds or {})

    return guarded(serve, _signals(name)) or max(codes)


def _with_keys(words: Sequence[str], objects: Sequence[str]) -> list[str]:
    """Adds the keys of `objects` to the leading words that have no key."""
    count = 0
    while count < len(words) and not words[count].startswith("-") and _is_object(words[count]):
        count += 1
    given, rest = list(words[:count]), list(words[count:])
    keys = [key.rstrip("*") for key in objects]
    if objects and objects[-1].endswith("*") and len(given) >= len(keys):
        given[len(keys) - 1 :] = [shlex.join(given[len(keys) - 1 :])]
    for key in keys[: len(given)]:
        if any(word.startswith(f"{key}=") for word in rest):
            raise UserError(f"{key} is given twice: once without a key, and as {key}=. Remove one")
    # Surplus words remain unchanged; they are refused later because they have no value.
    return [f"{key}={word}" for key, word in zip(keys, given, strict=False)] + given[len(keys) :] + rest


def _is_object(word: str) -> bool:
    path = "/" in word.partition("=")[0] and len(word) < 1000 and Path(word).exists()  # a path may hold "="
    return "=" not in word or path


def _signals(name: str | None) -> tuple[int, ...]:
    return (signal.SIGINT,) if name is None else (signal.SIGINT, signal.SIGTERM)  # training handles SIGTERM itself


@contextmanager
def _stoppable(signums: Sequence[int]) -> Iterator[None]:
    """Turns signals into exceptions, so that partial files are cleaned up; the exit code is 128 + the signal."""

    def exception(number: int) -> BaseException:
        return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        sys.unraisablehook = lambda _: None  # of objects that were being created or deleted
        errors.stopped_by = errors.stopped_by or exception(number)
        raise exception(number)

    before = {n: signal.signal(n, stop) for n in signums if signal.getsignal(n) is not signal.SIG_IGN}
    try:
        yield
    except Exception:
        # The exception of a signal may come between any two steps of a library, whose cleanup can then fail.
        if errors.stopped_by is not None:
            raise errors.stopped_by from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        errors.stopped_by = None


def _serve(
    command: Callable[[Config], None], words: list[str], name: str | None, codes: list[int], kinds: Mapping[str, str]
) -> None:
    if name is None:
        if words[0].startswith("-") or "=" in words[0]:
            raise UserError(f"the first word must name an experiment, such as quickstart, not '{words[0]}'")
        first, words = words[0], words[1:]
        recipe = find_recipe(first)
    else:
        first, recipe = name, Recipe(EXPERIMENTS, name)
    flags = [w for i, w in enumerate(words) if w.startswith("-") or (i and words[i - 1] in ("--cfg", "--package"))]
    unknown = [w for w in flags if w.startswith("-") and w.partition("=")[0] not in FLAGS]
    if unknown:
        raise UserError(f"unknown option {unknown[0]}. Available: {', '.join(FLAGS)}, and keys as key=value")
    overrides = [w for w in words if w not in flags]
    plan = plan_composition(recipe, overrides)
    parsed = parse(plan.overrides)
    launch = [str(o.value()) for o in parsed if o.key_or_group == LAUNCH]
    sweep = bool(launch) or any(flag in ("-m", "--multirun") for flag in flags)
    composed = resolve(plan._replace(overrides=[first_choice(o) for o in parsed] if sweep else plan.overrides))
    check(composed)
    if name is None:
        _check_whole(composed, first)
    for key, annotation in kinds.items():
        if composed.get(key) is not None:
            check_kind(key, composed[key], annotation)
    if "local" in launch and composed.get("trainer", {}).get("devices", 1) != 1:
        raise UserError("launch=local runs each job in one process. Remove launch, or trainer.devices")

    def start(plain: Config, task: Sequence[str]) -> int:
        if name is None:  # Lightning starts further processes with these words
            folder = _quoted(f"run.dir={plain['run']['dir']}", ("run.dir",))
            sys.argv = [sys.argv[0], "train", first, *task, folder]
        code = guarded(lambda: command(plain), _signals(name))
        codes.append(code)
        return code

    if not flags and not sweep:
        start(composed, [word for word in plan.overrides if not word.startswith("hydra.")])
        return

    def job(config: Any) -> None:
        hydra = HydraConfig.get()
        if sweep and name is None:
            config = OmegaConf.merge(config, {"run": {"dir": hydra.runtime.output_dir}})
        plain: Config = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
        check(plain)
        HydraConfig.instance().cfg = None  # otherwise Lightning adds words for Hydra's command line
        code = start(plain, [str(word) for word in hydra.overrides.task if not str(word).startswith(f"+{LAUNCH}=")])
        if code > 128 or (launch and code):  # a signal ends the whole sweep, and a failed launched job counts as failed
            raise SystemExit(code)

    quiet = ["hydra/job_logging=disabled", "hydra/hydra_logging=disabled", "hydra.output_subdir=null"]
    fixed = [repr(o.key_or_group) for o in parsed if not o.is_sweep_override()]
    output = [
        "hydra.run.dir=${run.dir}",
        "hydra.sweep.dir=${run.dir}" if name is None else f"hydra.sweep.dir=runs/sweeps/{name}",
        "hydra.sweep.subdir=${hydra.job.override_dirname}",
        f"hydra.job.config.override_dirname.exclude_keys=[{','.join(fixed)}]",
    ]
    if launch:
        logs = f"{composed['run']['dir'] if name is None else f'runs/sweeps/{name}'}/.submitit"
        say(f"waiting for the jobs; their output is in {logs}")
    if sweep and not {"-m", "--multirun"} & set(flags):
        flags.append("--multirun")
    sys.argv = [sys.argv[0], *flags, *quiet, *output, *plan.overrides]
    GlobalHydra.instance().clear()
    hydra_main(version_base="1.3", config_path=str(plan.folder), config_name=plan.stem)(job)()


def _check_whole(config: Config, name: str) -> None:
    """Checks that a recipe has everything that a run needs; raises `UserError` if not."""
    plain(config, name)  # otherwise the checkpoints of the run would be refused
    for key in ("run", "trainer", "data", "representation", "task", "optimizer", "callbacks"):
        node = config.get(key)
        if not isinstance(node, Mapping) or (key not in ("run", "callbacks") and "_target_" not in node):
            raise UserError(f"{name}: no {key}. Begin the recipe with the defaults of another recipe, or with /base")
    if not config["run"].get("dir"):
        raise UserError(f"{name}: run.dir is empty. Set it to the directory of the run")
    if "max_steps" not in config["trainer"]:
        raise UserError(f"{name}: trainer.max_steps is missing. Set it; -1 trains without end")
    for key in ("denoiser", "process", "condition"):
        if key in config and not (isinstance(config[key], Mapping) and "_target_" in config[key]):
            raise UserError(f"{name}: {key} has no _target_. Replace it with one of experiments/{key}: {key}=...")
    for key, value in config.get("denoiser", {}).items():
        if isinstance(value, int) and value < 0:
            raise UserError(f"denoiser.{key}={value}: must not be negative")
    for key in ("experiment", "seed", "ema", "logger"):
        if key not in config:
            raise UserError(f"{name}: no {key}. Begin the recipe with the defaults of another recipe, or with /base")


def _make_variables() -> list[str]:
    """Returns the variables given to make, as words: `EXP` names the recipe, other upper-case names are keys.

    Make passes them in MAKEFLAGS after ` -- `, latest first, with escaped spaces and doubled dollar signs. Read from
    there, they have not been processed by a shell.
    """
    variables = (" " + os.environ.get("MAKEFLAGS", "")).partition(" -- ")[2]
    words = [re.sub(r"\\(.)", r"\1", w).replace("$$", "$") for w in re.findall(r"(?:\\.|[^\\ ])+", variables)]
    pairs = [word.partition("=") for word in reversed(words)]
    names = [value for key, _, value in pairs if key == "EXP"]
    keys = [(key.lower() if key.isupper() else key, value) for key, _, value in pairs]
    return names + [f"{key}={value}" for key, value in keys if key not in ("exp", "python", "venv")]


def _quoted(word: str, keys: Sequence[str]) -> str:
    key, separator, value = word.partition("=")
    if not separator or key not in keys or value in ("", "null"):
        return word
    # Hydra takes a backslash literally, except right before a quote, where it has to be doubled.
    escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), value).replace("${", "\\${")
    return f"{key}='{escaped}'"


def guarded(action: Callable[[], None], signums: Sequence[int] = ()) -> int:
    """Runs `action` and returns the exit code; a signal of `signums` ends it after it has cleaned up.

    For an error that the user can fix, it prints one line and returns 1; FLAME_MDM_TRACEBACK=1 adds the traceback.
    """
    hook = sys.unraisablehook
    try:
        with _stoppable(signums):
            action()
    except (UserError, ValueError, OSError, MemoryError, RecursionError, RuntimeError, ImportError) as error:
        memory = isinstance(error, MemoryError)
        memory |= not isinstance(error, UserError) and NO_MEMORY.search(str(error)) is not None
        if isinstance(error, RuntimeError | ImportError) and not (memory or isinstance(error, RecursionError)):
            raise
        if os.environ.get("FLAME_MDM_TRACEBACK") == "1":
            traceback.print_exc()
        message = (
            f"out of memory ({first_line(error)}). Free memory, or reduce the size" if memory else first_line(error)
        )
        say(f"error: {message}", error=True)
        return 1
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt:
        say("interrupted", error=True)
        return 130
    finally:
        sys.unraisablehook = hook
    return 0
