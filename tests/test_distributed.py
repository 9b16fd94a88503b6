"""Two real processes train what one would, and jobs of launchers; that they cannot start is a failure."""

import os
import re
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from support.fixtures import ROOT, script
from support.refusals import one_error
from support.runs import RUN, TWO, alarm, ended, finish, forked, free_port, reference, spawn
from torchmetrics import MeanMetric

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load_task
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import train
from flame_mdm.config import Config, compose, instantiate
from flame_mdm.config.sweeps import run_recipe
from flame_mdm.errors import UserError
from flame_mdm.runs import read_history
from flame_mdm.task import GeneratorTask


@pytest.mark.slow
def test_two_processes_are_one_with_both_batches(tiny, tmp_path):
    """Launched by Lightning."""
    words = [*tiny, *RUN, f"data_root={tmp_path / 'data'}", "data.source.workers=1"]
    ours = ["callbacks.samples.every_n_steps=2", "trainer.max_steps=4"]
    ours.append("+task.checkpoint_activations=true")  # changes no weights
    line = ["flame_mdm", "train", "quickstart", *words, *TWO, *ours]
    code, out, err = ended(forked(tmp_path, line), tmp_path)
    assert code == 0, err
    assert (
        "batch: 2 clips = 1 x 2 processes x 1 accumulated; optimizer.lr=0.05 is not scaled with the batch"
        in out
    )
    assert (
        out.count("steps: 0 to 4")
        == out.count("player: ")
        == err.count("preparing synthetic:   0%")
        == 1
    )
    expected = reference(words, 4)
    trained = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")["state_dict"]
    torch.testing.assert_close(trained, expected, rtol=1e-4, atol=1e-6)

    # Validation: 5 clips in batches of one, so 3 batches on one process, 2 on the other.
    config = compose("quickstart", words)
    task = load_task(tmp_path / "run" / "checkpoints" / "last.ckpt", GeneratorTask)
    task.load_state_dict(expected)
    data = instantiate(
        config["data"], representation=task.generator.representation, seed=config["seed"]
    )
    data.setup("fit")
    with torch.no_grad():
        for index, batch in enumerate(data.val_dataloader()):
            task.eval().validation_step(batch, index)
    assert len(data.val) == 5
    loss = float(cast(MeanMetric, task.val_losses["loss"]).compute())
    assert read_history(tmp_path / "run")["val/loss"].popitem()[1] == pytest.approx(loss, rel=1e-4)


@pytest.mark.robustness
def test_torchrun_starts_a_killed_group_again(tiny, tmp_path, subtests):
    """The first process dies at step 3 and leaves its lock; then SIGTERM ends torchrun at step 6."""
    words = [*tiny, *RUN, "callbacks.samples=null"]
    counter = "TORCHELASTIC_RESTART_COUNT"
    alarms = [
        *alarm(tmp_path, "kill", step=3, rank=0, attempt=0, counter=counter, signal="SIGKILL"),
        *alarm(
            tmp_path,
            "end",
            step=6,
            rank=0,
            attempt=1,
            counter=counter,
            signal="SIGTERM",
            parent=True,
        ),
    ]
    torchrun = ["torch.distributed.run", "--nproc-per-node=2", "--max-restarts=1", "--standalone"]
    command = [
        *torchrun,
        "-m",
        "flame_mdm",
        "train",
        "quickstart",
        *words,
        *TWO,
        *alarms,
        "trainer.max_steps=100000",
    ]
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    # Else torchrun keeps its store, and the new group finds the addresses of the dead one in there.
    _, out, err = finish(
        spawn(
            command, PYTHONPATH=path, TORCH_DISABLE_SHARE_RDZV_TCP_STORE="1", PYTHONUNBUFFERED="1"
        )
    )
    for line in ("steps: 0 to 100000", "died; taking over its run directory", "steps: 2 to 100000"):
        with subtests.test(line=line):
            assert out.count(line) == 1, err
    step = int(re.findall(r"stopped at step (\d+)", out)[0])
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert checkpoint["global_step"] == step >= 6
    torch.testing.assert_close(
        checkpoint["state_dict"], reference(words, step), rtol=1e-4, atol=1e-6
    )
    assert not (tmp_path / "run" / "run.lock").exists()


@pytest.mark.slow
def test_data_is_prepared_once_and_no_process_is_without_a_validation_batch(tiny, subtests):
    config = compose("quickstart", [*tiny, "data.batch_size=1"])
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=0)
    for part in (data, GeneratorTask.build(config, representation)):
        with subtests.test(part=type(part).__name__):
            # With this value, Lightning asks only the first process of the first machine.
            assert part.prepare_data_per_node is False
    data.prepare_data()
    data.setup("fit")
    for world, batches in ((1, 5), (2, 3), (7, 5)):
        with subtests.test(world=world):
            data.trainer = SimpleNamespace(global_rank=0, world_size=world)  # type: ignore[assignment]
            assert len(data.val_dataloader()) == batches
            data.trainer.global_rank = world - 1  # type: ignore[union-attr]
            assert len(data.val_dataloader()) >= 1


@pytest.mark.slow
def test_processes_are_started_with_the_words_of_one_job(tiny, tmp_path, monkeypatch, subtests):
    seen: list[tuple[list[str], Config]] = []
    note = partial(run_recipe, lambda config: seen.append((sys.argv[1:], config)), train.USAGE)
    monkeypatch.setattr(train, "main", note)
    monkeypatch.setattr(sys, "argv", ["flame-mdm", "train"])
    folder = f"run.dir={tmp_path / 'sweep'}"
    assert main(["train", "quickstart", *tiny[:-1], folder, "seed=1,2", "--multirun"]) == 0
    assert [config["run"]["dir"] for _, config in seen] == [
        str(tmp_path / "sweep" / f"seed={n}") for n in (1, 2)
    ]
    for (command, *words), config in seen:
        with subtests.test(seed=config["seed"]):
            assert command == "train"
            assert (
                config["callbacks"]["checkpoints"]["folder"]
                == f"{config['run']['dir']}/checkpoints"
            )
            assert compose(words[0], words[1:]) == config


@pytest.mark.robustness
def test_a_slurm_job_that_runs_out_of_time_is_requeued_and_ends_as_if_it_had_not(tiny, tmp_path):
    """Two tasks; SIGUSR2, which submitit asks SLURM for, comes at step 1 of 3."""
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(
        os.pathsep
    )
    programs = os.pathsep.join([str(ROOT / "tests" / "support" / "slurm"), os.environ["PATH"]])
    # A stand-in for SLURM, with the commands that submitit needs.
    cluster = {
        "CLUSTER": str(tmp_path),
        "PYTHONPATH": path,
        "PATH": programs,
    }
    cluster |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    words = [*tiny, *RUN, "callbacks.samples=null", "trainer.max_steps=3"]
    time_over = alarm(
        tmp_path, "time", step=1, rank=0, attempt=0, counter="SLURM_RESTART_COUNT", signal="SIGUSR2"
    )
    launch = ["launch=slurm", "hydra.launcher.partition=gpu", "hydra.launcher.timeout_min=90"]
    code, out, err = finish(
        spawn(["flame_mdm", "train", "quickstart", *words, *time_over, *TWO, *launch], **cluster)
    )
    logs = "\n".join(path.read_text() for path in (tmp_path / "run" / ".submitit").rglob("*.out"))
    assert code == 0, out + err + logs
    assert (tmp_path / "listed").read_text() == "requeue 7\n"
    while len(codes := (tmp_path / "codes").read_text().split()) < 2:
        time.sleep(0.1)  # the result of a job is in its file before the job has ended
    assert codes == ["140", "0"]  # 128 + SIGUSR2
    assert "steps: 2 to 3" in logs
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert checkpoint["global_step"] == 3
    torch.testing.assert_close(checkpoint["state_dict"], reference(words, 3), rtol=1e-4, atol=1e-6)

    script = tmp_path / "script.sh"
    listed = set(re.findall(r"^#SBATCH --(.+)$", script.read_text(), re.MULTILINE))
    options = {
        "nodes=1",
        "ntasks-per-node=2",
        "gpus-per-node=2",
        "time=90",
        "partition=gpu",
        "requeue",
    }
    assert options | {"job-name=quickstart", "signal=USR2@120"} <= listed
    assert_lints("shellcheck", "--severity=warning", script)


@pytest.mark.robustness
def test_jobs_of_a_sweep_run_in_processes_and_folders_of_their_own(tiny, tmp_path):
    """On this machine; the second one is refused."""
    (tmp_path / "sweep" / "seed=2").mkdir(parents=True)
    (tmp_path / "sweep" / "seed=2" / "config.yaml").write_text("run: {dir: another}\n")
    words = [
        "train",
        "quickstart",
        *tiny[:-1],
        f"run.dir={tmp_path / 'sweep'}",
        "trainer.max_steps=0",
        "seed=1,2",
    ]
    words += ["launch=local", "hydra.launcher.timeout_min=5"]
    code, out, err = finish(spawn(["flame_mdm", *words], PYTHONPATH=str(ROOT)))
    assert code == 1, out + err
    logs = "\n".join(
        path.read_text() for path in (tmp_path / "sweep" / ".submitit").rglob("*log.*")
    )
    assert "seed=1: already trained for 0 steps" in logs
    assert "seed=2 contains a run with a different configuration" in logs


@pytest.mark.robustness
def test_evaluations_run_as_jobs_of_a_launcher(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [
        "evaluate",
        "missing.ckpt",
        "extractor=none",
        "seed=0,1",
        "launch=local",
        "hydra.launcher.timeout_min=5",
    ]
    code, out, err = finish(spawn(["flame_mdm", *words], PYTHONPATH=str(ROOT)))
    assert code == 1, out + err
    assert "waiting for the jobs; their output is in runs/sweeps/.submitit" in out
    logs = [path.read_text() for path in Path("runs/sweeps/.submitit").rglob("*log.*")]
    assert sum("error: missing.ckpt: no such checkpoint" in log for log in logs) == 2, logs


REFUSED = {
    "train quickstart launch=slurmm": "unknown launch 'slurmm'. Did you mean slurm?",
    "train quickstart launch=local trainer.devices=2": "launch=local runs each job in one process",
    "train quickstart launch=slurm seed=1,2 logger=csv,nothing": "unknown logger 'nothing'",
    "train quickstart launch=slurm hydra.launcher.partitionn=gpu": "partitionn",
    "train quickstart launch=slurm": "launch=slurm: this machine has no srun. Run the command on a",
    "train quickstart seed=0,1": "seed=0,1: several values define a sweep with one run per value. Add --multirun",
    "convert a b launch=slurm": "unknown config key 'launch'",
    "convert a b --multirun": "unknown option --multirun",
}


def test_what_is_wrong_is_told_before_anything_is_submitted(
    tmp_path, capsys, monkeypatch, subtests
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "")  # no srun
    for line, message in REFUSED.items():
        with subtests.test(line=line, message=message):
            assert main(line.split()) == 1
            assert message in one_error(capsys)
    assert list(tmp_path.iterdir()) == []


def test_launchers_are_found_for_recipes_in_folders_or_named_by_their_extra(monkeypatch, subtests):
    for recipe, launcher in (("humanml3d/mdm", "local"), ("motion_clip/synthetic", "slurm")):
        with subtests.test(recipe=recipe, launcher=launcher):
            assert compose(recipe, [f"launch={launcher}"]) == compose(recipe)
    monkeypatch.setattr("flame_mdm.config.composition.source_file", lambda module: None)
    with pytest.raises(
        UserError, match=r'launch=slurm requires .*\. Run pip install "flame-mdm\[slurm\]"'
    ):
        compose("quickstart", ["launch=slurm"])


def assert_lints(program: str, *words: str | Path) -> None:
    line = [Path(sys.executable).parent / program, *words]
    linted = subprocess.run(line, capture_output=True, text=True, check=False)
    assert linted.returncode == 0, linted.stdout + linted.stderr


def test_the_container_takes_torch_alone_from_its_index_and_any_base():
    text = (ROOT / "Dockerfile").read_text()
    installed = [line for line in text.splitlines() if "uv pip install" in line]
    assert len(installed) == 2
    assert all("-c constraints.txt" in line for line in installed)
    (torch_alone,) = [line for line in installed if "TORCH_INDEX" in line]
    assert "--no-deps" in torch_alone
    assert torch_alone.endswith(" torch")
    assert "FROM $BASE\n" in text, "another digest can be passed"
    assert re.search(r"^ARG BASE=\S+@sha256:[0-9a-f]{64}$", text, re.M), "the base has a digest"
    versions = {
        re.findall(r"\buv==([\d.]+)", (ROOT / name).read_text())[0]
        for name in ("Dockerfile", "Makefile")
    }
    assert len(versions) == 1, "both install the same version of uv"


def test_every_package_but_torch_is_pinned_with_hashes():
    packages = re.split(r"^(?=[A-Za-z])", (ROOT / "constraints.txt").read_text(), flags=re.M)[1:]
    assert len(packages) > 150
    unhashed = [package.split("==")[0] for package in packages if "--hash=sha256:" not in package]
    assert unhashed == ["torch"]


def test_uv_reads_the_settings_of_pip():
    settings = "\n".join(
        [
            "global.index-url='https://mirror.example/simple'",
            "global.find-links='/wheels'",
            "global.cert='/certificates.pem'",
            ":env:.find-links='/other wheels'",
        ]
    )
    variables = script("tools/install.py").uv_environment(
        settings, {"UV_DEFAULT_INDEX": "https://own.example"}
    )
    assert variables["UV_DEFAULT_INDEX"] == "https://own.example"
    assert variables["UV_FIND_LINKS"] == "/other wheels"
    assert variables["VIRTUAL_ENV"] == sys.prefix
    assert "/certificates.pem" not in variables.values()


def test_the_container_file_is_clean_and_copies_what_is_there():
    assert_lints("hadolint", ROOT / "Dockerfile")
    lines = [
        line.split()
        for line in (ROOT / "Dockerfile").read_text().splitlines()
        if line.startswith("COPY")
    ]
    copied = {name for _, *names, _ in lines for name in names}
    assert {"flame_mdm", "evaluators", "experiments", "constraints.txt", "pyproject.toml"} <= copied
    left_out = set((ROOT / ".dockerignore").read_text().split())
    assert all((ROOT / name).exists() and name not in left_out for name in copied)
