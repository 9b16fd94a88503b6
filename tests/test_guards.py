import json
import os
import resource
import subprocess
import sys
import textwrap

import pytest
import torch

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import compose, instantiate
from flame_mdm.errors import UserError
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.training.guards import LAST, PREVIOUS, AtomicCheckpoints, newest, only_run

pytestmark = pytest.mark.slow

QUICK = ["callbacks.samples=null", "callbacks.best=null", "callbacks.checkpoints.every_n_steps=2"]


@pytest.fixture(autouse=True)
def prepared(tiny: list[str]) -> None:
    """The data is there, so that nothing tells of its preparation."""
    config = compose("quickstart", tiny)
    instantiate(config["data"], representation=instantiate(config["representation"])).prepare_data()


def words(tiny: list[str], steps: int) -> list[str]:
    return ["quickstart", *tiny, *QUICK, f"trainer.max_steps={steps}", "trainer.log_every_n_steps=4"]


def break_loss(monkeypatch: pytest.MonkeyPatch, step: int, change) -> None:
    """Lets `change` have the loss terms of a step of training."""
    original, count = GaussianDiffusion.loss, [0]

    def loss(self, *args, **kwargs):
        count[0] += 1
        terms = original(self, *args, **kwargs)
        return {name: change(value) for name, value in terms.items()} if count[0] == step else terms

    monkeypatch.setattr(GaussianDiffusion, "loss", loss)


@pytest.mark.parametrize(
    ("change", "told"),
    [(lambda v: v * float("nan"), "is nan"), (lambda v: v / 0, "is inf"), (lambda v: v * 1e6, "(typical: ")],
)
def test_a_bad_loss_stops_before_a_checkpoint_is_spoiled(tiny, tmp_path, monkeypatch, capsys, change, told):
    break_loss(monkeypatch, 7, change)
    capsys.readouterr()
    assert main(["train", *words(tiny, 20)]) == 1
    message = capsys.readouterr().err
    assert message.startswith("error: the loss of step 7 ")
    assert told in message
    assert message.count("\n") == 1
    bad = json.loads((tmp_path / "run" / "bad_batch.json").read_text())
    assert bad["step"] == 7
    assert bad["batches"][0]["batch"] == 6
    assert len(bad["batches"][0]["ids"]) == 8
    checkpoint = read_checkpoint(tmp_path / "run" / "checkpoints" / LAST)
    assert checkpoint["global_step"] == 6
    assert all(value.isfinite().all() for value in checkpoint["state_dict"].values() if value.is_floating_point())


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory."), RuntimeError("can't allocate memory")]
)
def test_out_of_memory_names_the_batch(tiny, monkeypatch, capsys, error):
    def fail(value):
        raise error

    break_loss(monkeypatch, 3, fail)
    capsys.readouterr()
    assert main(["train", *words(tiny, 5)]) == 1
    message = capsys.readouterr().err
    assert message.startswith("error: out of memory at step 2 with a batch of 8 clips, ")
    assert "263 features. Lower data.batch_size" in message
    assert message.count("\n") == 1


def test_a_damaged_checkpoint_gives_way_to_the_one_before(tiny, tmp_path, capsys):
    assert main(["train", *words(tiny, 6)]) == 0
    folder = tmp_path / "run" / "checkpoints"
    whole = (folder / LAST).read_bytes()
    assert newest(folder) == (folder / LAST, 6)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1  # in the middle of a weight, where no structure tells
    for content in (whole[: len(whole) // 2], bytes(flipped), b""):
        (folder / LAST).write_bytes(content)
        capsys.readouterr()
        assert newest(folder) == (folder / PREVIOUS, 4)
        assert f"{folder / LAST}: damaged" in capsys.readouterr().out
    assert main(["train", *words(tiny, 6)]) == 0
    resumed = read_checkpoint(folder / LAST)
    (tmp_path / "whole.ckpt").write_bytes(whole)
    once = read_checkpoint(tmp_path / "whole.ckpt")
    assert all(torch.equal(resumed["state_dict"][k], v) for k, v in once["state_dict"].items())
    for name in (LAST, PREVIOUS):
        (folder / name).write_bytes(b"")
    with pytest.raises(UserError, match="no other checkpoint"):
        newest(folder)


def test_a_full_disk_leaves_the_checkpoint_before(tmp_path):
    io = AtomicCheckpoints()
    io.save_checkpoint({"global_step": 1, "config": {}, "facts": {}, "state_dict": {}}, tmp_path / LAST)
    before = (tmp_path / LAST).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(UserError, match=r"last\.ckpt: the checkpoint of step 2 cannot be written .*File too large"):
            io.save_checkpoint({"global_step": 2, "state_dict": {"a": torch.zeros(100_000)}}, tmp_path / LAST)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == [LAST]
    assert (tmp_path / LAST).read_bytes() == before


HOLD = """
import sys, pathlib
from flame_mdm.training.guards import only_run
with only_run(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_run_in_the_folder_is_refused_and_a_dead_one_taken_over(tiny, tmp_path, capsys):
    folder = tmp_path / "run"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(HOLD), str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        capsys.readouterr()
        assert main(["train", *words(tiny, 2)]) == 1
        message = capsys.readouterr().err
        assert f"process {other.pid} on " in message
        assert "is training in this directory" in message
        assert message.count("\n") == 1
        assert not (folder / "config.yaml").exists()
        other.kill()
    assert main(["train", *words(tiny, 2)]) == 0
    assert f"process {other.pid} on " in capsys.readouterr().out
    assert not (folder / "run.lock").exists()


def test_the_lock_ends_with_an_error(tmp_path):
    with pytest.raises(ValueError, match="inside"), only_run(tmp_path):
        raise ValueError("inside")
    assert list(tmp_path.iterdir()) == []
