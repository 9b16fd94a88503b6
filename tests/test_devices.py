"""Accelerators and devices that a machine does not have."""

import os

import torch

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import NO_GPU
from flame_mdm.training.fit import check_devices

MISSING = [
    (0, "trainer.accelerator=gpu", f"trainer.accelerator=gpu: {NO_GPU}. Drop it to train on the CPU"),
    (0, "trainer.accelerator=cuda", f"trainer.accelerator=cuda: {NO_GPU}. Drop it to train on the CPU"),
    (0, "trainer.devices=99", f"trainer.devices=99: this machine has 3 CPU cores, and {NO_GPU}. Give at most"),
    (1, "trainer.devices=2", "trainer.devices=2: this machine has 1 GPU. Give at most trainer.devices=1"),
    (2, "trainer.devices=4 trainer.accelerator=gpu", "trainer.devices=4: this machine has 2 GPUs. Give at most"),
]


def test_training_names_what_is_missing(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    for gpus, words, message in MISSING:
        monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)  # noqa: B023 (called before the next)
        folders = [f"run.dir={tmp_path / 'run'}", f"data_root={tmp_path}"]
        assert main(["train", "quickstart", *folders, *words.split()]) == 1
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_a_cpu_may_be_told_to_run_more_processes_than_cores(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    check_devices({"accelerator": "cpu", "devices": 2})
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    check_devices({"accelerator": "auto", "devices": 2})
    check_devices({"accelerator": "cpu", "devices": 8})
