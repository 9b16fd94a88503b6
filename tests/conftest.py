"""Shared by all tests: one thread, no network, and a tiny experiment."""

import os

os.environ["HF_HUB_OFFLINE"] = "1"  # before transformers is imported

from pathlib import Path

import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")  # the same examples on every machine

TINY = [
    "data.source.clips=60",
    "data.batch_size=8",
    "denoiser.latent_dim=16",
    "denoiser.ff_size=16",
    "denoiser.num_layers=1",
    "denoiser.num_heads=2",
    "condition.features=16",
    "process.num_train_timesteps=10",
    "task.num_inference_steps=5",
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "callbacks.samples.seconds=1.5",
]
"""Overrides that make the quick-start experiment train in a second."""


@pytest.fixture(scope="session")
def data_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of prepared data sets, shared by the tests of a process."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def tiny(tmp_path: Path, data_root: Path) -> list[str]:
    """Overrides of a tiny experiment with a run folder of its own, `tmp_path / "run"`."""
    return [*TINY, f"data_root={data_root}", f"run.dir={tmp_path / 'run'}"]
