"""Jobs by Hydra's submitit launcher: in processes of this machine, and on a SLURM of four small programs."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import ROOT
from support.motions import sway
from support.runs import RUN, TWO, alarm, finish, free_port, reference, spawn

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import compose
from flame_mdm.errors import UserError

SLURM = Path(__file__).parent / "support" / "slurm"
"""The four programs of SLURM that submitit calls, as far as it needs them."""


@pytest.fixture
def cluster(tmp_path: Path) -> dict[str, str]:
    """Environment variables with which these programs are found."""
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    programs = os.pathsep.join([str(SLURM), os.environ["PATH"]])
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    return {"CLUSTER": str(tmp_path), "PYTHONPATH": path, "PATH": programs, **address}


@pytest.mark.slow
def test_a_slurm_job_that_runs_out_of_time_is_requeued_and_ends_as_if_it_had_not(tiny, tmp_path, cluster):
    """Two tasks; SIGUSR2, which submitit asks SLURM for, comes at step 1 of 3."""
    words = [*tiny, *RUN, "callbacks.samples=null", "trainer.max_steps=3"]
    time_over = alarm(tmp_path, "time", step=1, rank=0, attempt=0, counter="SLURM_RESTART_COUNT", signal="SIGUSR2")
    launch = ["launch=slurm", "hydra.launcher.partition=gpu", "hydra.launcher.timeout_min=90"]
    code, out, err = finish(spawn(["flame_mdm", "train", "quickstart", *words, *time_over, *TWO, *launch], **cluster))
    logs = "\n".join(path.read_text() for path in (tmp_path / "run" / ".submitit").rglob("*.out"))
    assert code == 0, out + err + logs
    assert "job 7 was requeued" in logs
    assert (tmp_path / "listed").read_text() == "requeue 7\n"
    deadline = time.monotonic() + 20
    while len(codes := (tmp_path / "codes").read_text().split()) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)  # the result of a job stands in its file before the job has ended
    assert codes == ["140", "0"]  # 128 + SIGUSR2
    assert "steps: 2 to 3" in logs
    checkpoints = tmp_path / "run" / "checkpoints"
    assert sorted(path.name for path in checkpoints.iterdir()) == ["last.ckpt", "previous.ckpt"]
    checkpoint = read_checkpoint(checkpoints / "last.ckpt")
    assert checkpoint["global_step"] == 3
    torch.testing.assert_close(checkpoint["state_dict"], reference(words, 3), rtol=1e-4, atol=1e-6)

    script = tmp_path / "script.sh"
    listed = {line.removeprefix("#SBATCH --") for line in script.read_text().splitlines() if line.startswith("#SBATCH")}
    options = {"nodes=1", "ntasks-per-node=2", "gpus-per-node=2", "time=90", "partition=gpu", "requeue"}
    assert options | {"job-name=quickstart", "signal=USR2@120"} <= listed
    linter = Path(sys.executable).parent / "shellcheck"
    for command in (["bash", "-n", script], [linter, "--severity=warning", script]):
        linted = subprocess.run(command, capture_output=True, text=True, check=False)
        assert linted.returncode == 0, linted.stdout + linted.stderr


@pytest.mark.slow
def test_jobs_of_a_sweep_run_in_processes_and_folders_of_their_own(tmp_path, monkeypatch):
    """On this machine; the first one is refused."""
    monkeypatch.chdir(tmp_path)
    np.savez("walk.npz", joints=sway(20).joints, fps=30.0)
    words = ["convert", "walk.npz", "out.bvh", "fps=1e9,20", "launch=local", "hydra.launcher.timeout_min=5"]
    code, out, err = finish(spawn(["flame_mdm", *words], PYTHONPATH=str(ROOT)))
    assert code == 1, out + err
    assert "waiting for the jobs; their output is in runs/sweeps/.submitit" in out
    logs = "\n".join(path.read_text() for path in Path("runs/sweeps/.submitit").rglob("*log.err"))
    assert "error: walk.npz: fps is" in logs
    assert (tmp_path / "out.bvh").exists()


REFUSED = {
    "train quickstart launch=slurmm": "no launch is called 'slurmm'. Did you mean slurm?",
    "train quickstart launch=local trainer.devices=2": "launch=local runs each job in one process",
    "train quickstart launch=slurm seed=1,2 logger=csv,nothing": "no logger is called 'nothing'",
    "train quickstart launch=slurm hydra.launcher.partitionn=gpu": "partitionn",
    "convert a b launch=slurm fps=1,x": "fps=x: must be a finite number",
}


def test_what_is_wrong_is_told_before_anything_is_submitted(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line, message in REFUSED.items():
        assert main(line.split()) == 1
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert message in error
        assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_launchers_are_found_for_recipes_in_folders_or_named_by_their_extra(monkeypatch):
    for recipe, launcher in (("humanml3d/mdm", "local"), ("motion_clip/synthetic", "slurm")):
        assert compose(recipe, [f"launch={launcher}"]) == compose(recipe)
    monkeypatch.setattr("flame_mdm.config.composition.source_file", lambda module: None)
    with pytest.raises(UserError, match=r"launch=slurm needs .*: pip install flame-mdm\[slurm\]"):
        compose("quickstart", ["launch=slurm"])


def test_the_container_file_is_clean_and_copies_what_is_there():
    linter = Path(sys.executable).parent / "hadolint"
    linted = subprocess.run([linter, ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert linted.returncode == 0, linted.stdout + linted.stderr
    lines = [line.split() for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith("COPY")]
    copied = {name for _, *names, _ in lines for name in names}
    assert {"flame_mdm", "evaluators", "experiments", "constraints.txt", "pyproject.toml"} <= copied
    left_out = set((ROOT / ".dockerignore").read_text().split())
    assert all((ROOT / name).exists() and name not in left_out for name in copied)
