"""Kills at random moments change nothing; the start of a command imports no more than it needs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@pytest.mark.robustness
@pytest.mark.slow
def test_kills_at_random_moments_change_nothing():
    line = [sys.executable, str(ROOT / "tests" / "support" / "kill_resume.py"), "4"]
    done = subprocess.run(line, capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "weights equal bit for bit: True" in done.stdout
    assert "results equal except for measured times: True" in done.stdout
    assert done.stdout.count("; the same |") == 4
    assert "SIGKILL" in done.stdout
    assert "SIGTERM" in done.stdout


@pytest.mark.slow
def test_help_and_misspelled_keys_do_not_wait_for_torch(tmp_path):
    code = """
import sys
from importlib import import_module
def run(command, words):
    try:
        return import_module(f"flame_mdm.commands.{command}").main(words)
    except SystemExit as stop:
        return stop.code
for command in "train sample edit evaluate prepare browse convert export".split():
    assert run(command, ["--help"]) == 0, command
    assert run(command, (["quickstart"] if command == "train" else []) + ["seeed=1"]) in (1, 2), command
    assert not {"torch", "lightning", "transformers", "scipy"} & set(sys.modules), command
"""
    line = [sys.executable, "-c", code]
    done = subprocess.run(line, capture_output=True, text=True, env=ENVIRONMENT, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
