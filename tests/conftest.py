"""Shared by all tests: one thread, no network, and a tiny experiment."""

import gc
import math
import os

os.environ["HF_HUB_OFFLINE"] = "1"  # before transformers is imported
os.environ.pop("MAKELEVEL", None)  # commands say the same whether make or pytest started the tests
os.environ.pop("MAKEFLAGS", None)

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import settings
from support.distributed import GlooPool
from support.fixtures import compositions_once, parts_once, recipe
from support.npm import node_modules as node_modules
from support.refusals import Refused
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.config import composition
from flame_mdm.data import parallel
from flame_mdm.sampling import output

torch.set_num_threads(1)
# Imports make millions of objects that stay; `pytest_collection_finish` enables it again
gc.disable()
# Tests run on all cores: more processes would only import torch again
parallel.PATIENCE = math.inf
composition.compose_unchecked = compositions_once(composition.compose_unchecked)
parts_once()
# Pictures of samples have a sixteenth of their pixels; `test_visualize.py` looks at larger ones
output.write_gif = partial(output.write_gif, size=64)
output.contact_sheet = partial(output.contact_sheet, size=48)
output.write_mp4 = partial(output.write_mp4, size=64)
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")  # the same examples on every machine


def pytest_collection_finish() -> None:
    """Leaves what was imported out of collections of garbage, which take a tenth of the time otherwise."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()


@pytest.fixture(scope="session")
def data_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of prepared data sets, shared by the tests of a process."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def tiny(tmp_path: Path, data_root: Path) -> list[str]:
    """Overrides of a tiny experiment with a run folder of its own, `tmp_path / "run"`."""
    return [*TINY, f"data_root={data_root}", f"run.dir={tmp_path / 'run'}"]


@pytest.fixture(scope="session")
def trained(tmp_path_factory, data_root) -> Path:
    """A checkpoint of a tiny model; its data is prepared."""
    folder = tmp_path_factory.mktemp("trained")
    words = [
        *TINY,
        f"data_root={data_root}",
        f"run.dir={folder}",
        "callbacks.samples=null",
        "callbacks.best=null",
    ]
    assert main(["train", "quickstart", *words, "trainer.max_steps=2", "logger=csv"]) == 0
    return folder / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="session")
def pool() -> Iterator[GlooPool]:
    """Two processes of one group."""
    with GlooPool() as pool:
        yield pool


@pytest.fixture
def composed_once(monkeypatch) -> None:
    """Tables and pages read recipes that are composed only once."""
    monkeypatch.setattr("flame_mdm.reporting.tables.settings.compose", recipe)


@pytest.fixture
def bad(tmp_path) -> Path:
    """Where the malformed files lie."""
    folder = tmp_path / "bad"
    folder.mkdir()
    return folder


@pytest.fixture
def refused(tmp_path, monkeypatch, capfd, trained, data_root) -> Iterator[Refused]:
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("FLAME_MDM_DATA", str(data_root))
    monkeypatch.delenv("FLAME_MDM_TRACEBACK", raising=False)
    refused = Refused(folder, capfd, [trained.parent.parent, data_root])
    yield refused
    assert refused.count > 0
    assert not refused.faults, f"{len(refused.faults)} of {refused.count}:\n" + "\n".join(
        refused.faults
    )


@pytest.fixture
def attacked(refused) -> Refused:
    """`refused` for crafted input: 10 seconds and 1 GiB of memory for each command."""
    refused.seconds, refused.memory = 10, 2**30
    return refused
