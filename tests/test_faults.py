"""Kills at random moments change nothing; the start of a command imports no more than it needs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@pytest.mark.slow
def test_kills_at_random_moments_change_nothing():
    done = subprocess.run(
        [sys.executable, str(ROOT / "tests" / "support" / "kill_resume.py"), "4"],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "weights equal bit for bit: True" in done.stdout
    assert "results equal except for measured times: True" in done.stdout
    assert done.stdout.count("; the same |") == 4
    assert "SIGKILL" in done.stdout
    assert "SIGTERM" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "sample", "edit", "evaluate", "prepare", "browse", "convert", "export"])
def test_help_and_misspelt_keys_do_not_wait_for_torch(command, tmp_path):
    words = {"train": ["quickstart", "seeed=1"]}.get(command, ["seeed=1"])
    code = f"""
import sys
from flame_mdm.commands.{command} import main
def run(words):
    try:
        return main(words)
    except SystemExit as stop:
        return stop.code
assert run(["--help"]) == 0
assert run({words}) in (1, 2)
assert not {{"torch", "lightning", "transformers", "scipy"}} & set(sys.modules), sorted(sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, done.stderr
