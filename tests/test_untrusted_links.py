"""Folders that somebody else has filled: no link in them makes the product write, empty or remove a file elsewhere."""

import os
import re
import signal
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from weakref import finalize

import numpy as np
import pytest
import torch
from support.fixtures import ROOT
from support.pages import a_run
from support.refusals import one_line_error
from support.stores import OwnClips, clip

from evaluators.audit import _inputs as audited_inputs
from evaluators.sources import _write as write_motions_of_evaluation
from flame_mdm.__main__ import main
from flame_mdm.checkpoints import adapters, hub, onnx_export, runner
from flame_mdm.checkpoints.model_files import write_model_file
from flame_mdm.conditions.text import EncodedCaptions, PretrainedText
from flame_mdm.config import command_line, sweeps
from flame_mdm.data import archives
from flame_mdm.data.store import Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.data.verify import report as verify_data
from flame_mdm.errors import UserError, say
from flame_mdm.formats import USD, WRITTEN
from flame_mdm.formats.motion import Motion
from flame_mdm.reporting.browse import write_page
from flame_mdm.reporting.report import write_report
from flame_mdm.reporting.tables.format import Table
from flame_mdm.reporting.tables.format import write as write_table
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.safe_io import atomic_folder, atomic_write, locked, naming, paths, write_json
from flame_mdm.sampling.output import write_motions
from flame_mdm.training.checkpointing import AtomicCheckpoints
from flame_mdm.training.guards import only_run
from flame_mdm.training.loggers import History
from flame_mdm.visualize import write_player

VICTIM = b"the only copy of somebody's work\n"
MOTION = Motion(np.zeros((2, 22, 3), np.float32), 20.0, SMPL22, text="a person walks")


def save_checkpoint(run: Path) -> None:
    for step in (1, 2):  # the second one moves the first to previous.ckpt
        AtomicCheckpoints(run / "checkpoints").save_checkpoint(
            {"global_step": step}, run / "checkpoints" / "last.ckpt"
        )


def train_in(run: Path) -> None:
    with only_run(run):
        save_checkpoint(run)
        History(run).log_metrics({"train/loss": 1.0}, 1)
        write_json(run / "bad_batch.json", {})


def prepare(root: Path) -> None:
    write_store(root / "mine-humanml", OwnClips(clip("a")), HumanML("smpl22", "clean"))


def encode_captions(root: Path) -> None:
    encoder: Any = object.__new__(PretrainedText)
    encoded = EncodedCaptions(
        ["a"], torch.zeros(1, 2), torch.zeros(1, 2).half(), torch.tensor([0, 1])
    )
    vars(encoder).update(
        freeze=True,
        _cache_path=lambda captions, folder: folder / "model-0123.safetensors",
        _distinct=list,
        _encode_frozen=lambda *_, **__: encoded,
        _pretrained=SimpleNamespace(network=None),
    )
    with (
        pytest.warns(UserWarning, match="rebuilding it")
        if (root / "text" / "model-0123.safetensors").exists()
        else nullcontext()
    ):
        PretrainedText.precompute(encoder, ["a"], root / "text")


def sample(out: Path) -> None:
    paths.check_within(out / "walk", out)
    write_motions(out / "walk", [MOTION], {"seed": 0})


def page(out: Path) -> None:
    write_player(out / "player.html", [MOTION])


def any_file(out: Path) -> None:
    with atomic_write(out / "part" / "any.npz", within=out) as temporary:
        np.savez(temporary, a=np.zeros(1))


def any_json_file(out: Path) -> None:
    write_json(out / "lengths" / "any.json", {}, within=out)


def tables(out: Path) -> None:
    write_table(Table("mdm", "Table 1", []), out)


def audit(out: Path) -> None:
    succeed(["audit", f"cards={CARD}", f"out={out}"])


def audit_cache(out: Path) -> None:
    evaluator: Any = SimpleNamespace(
        extract=lambda _: {"generated": torch.zeros(1, 2)},
        metrics={},
        protocol=SimpleNamespace(metrics={}),
    )
    audited_inputs(evaluator, out / "real.npz", ["a"], lambda: [np.zeros((2, 3))])


def evaluated_motions(out: Path) -> None:
    row: Any = SimpleNamespace(id="a", text="walks")
    cost: Any = SimpleNamespace(model_dump=lambda: {"seconds": 1.0})
    write_motions_of_evaluation(out / "0.npz", [row], [np.zeros((2, 3), np.float32)], cost, "text")


def ratings(out: Path) -> None:
    answer = {"prompt": "p", "a": "ours", "b": "real", "choice": "a"}
    with TemporaryDirectory() as folder:
        answers = Path(folder, "x.json")
        write_json(answers, {"format": 1, "study": "s", "rater": "ann", "ratings": [answer]})
        succeed(["compare", f"ratings={answers}", f"out={out}/ratings.json"])


def compare(out: Path) -> None:
    with TemporaryDirectory() as folder:
        runs = [str(a_run(Path(folder, name))) for name in "ab"]
        succeed(["compare", *runs, f"out={out}/compare.html"])


def report(out: Path) -> None:
    with TemporaryDirectory() as folder:
        a_run(Path(folder, "run")).joinpath("config.yaml").rename(out / "config.yaml")
    write_report(out)


def store() -> Store:
    folder = TemporaryDirectory()
    finalize(
        opened := write_store(
            Path(folder.name, "s"), OwnClips(clip("a")), HumanML("smpl22", "clean")
        ),
        folder.cleanup,
    )
    return opened


def browse(out: Path) -> None:
    opened = store()
    write_page(out / "page.html", opened, HumanML(), opened.clips, "mine", None)


def verify(out: Path) -> None:
    opened, representation = store(), HumanML("smpl22", "clean")
    opened.verify()
    opened.verify, opened.folder, statistics = (lambda: None), out, opened.folder
    (out / "features.npy").write_bytes((statistics / "features.npy").read_bytes())
    data: Any = SimpleNamespace(
        open=lambda: opened, crop=SimpleNamespace(min_frames=1), representation=representation
    )
    verify_data(data)


def export(out: Path) -> None:
    network = torch.nn.Linear(1, 1).state_dict()
    write_model_file(out / "model.safetensors", network, config={}, facts={}, origin=None)


def runner_output(out: Path) -> None:
    with naming(out, ValueError):
        runner.write(out / "motion.npz", joints=MOTION.joints, fps=20.0)


def adapter(out: Path) -> None:
    with TemporaryDirectory() as folder:
        trained = Path(folder, "last.ckpt")
        torch.save({"config": {"adapter": {}}, "state_dict": {}}, trained)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                adapters, "read_checkpoint", lambda path: torch.load(path, weights_only=True)
            )
            adapters.write_adapter(out / "mine.safetensors", trained)


def motion_files(out: Path) -> None:
    walk = Motion(next(iter(Synthetic(clips=1).clips(20.0))).motion[:20], 20.0, SMPL22)
    for ending in CONVERTED:
        walk.save(out / f"walk{ending}")


def succeed(words: list[str]) -> None:
    """Runs a command line that must end with 0; if it does not, raises its error."""
    errors: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command_line, "say", lambda *lines, error=False: errors.extend(lines * error))
        if main(words):
            raise UserError(errors[-1].removeprefix("error: "))


# The other files need packages of extras.
CONVERTED = [ending for ending in WRITTEN if ending not in (".mp4", *USD)]
CARD = ROOT / "docs" / "benchmarks" / "audit" / "synthetic-none.json"
SAMPLES = [
    f"walk/{name}" for name in ("motion_000.npz", "motions.gif", "motions.png", "player.html")
]
WRITERS: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "train": (
        train_in,
        [
            "run.lock",
            "metrics.jsonl",
            "bad_batch.json",
            "checkpoints/last.ckpt",
            "checkpoints/previous.ckpt",
        ],
    ),
    "checkpoint": (save_checkpoint, ["checkpoints/last.ckpt", "checkpoints/previous.ckpt"]),
    "prepare": (
        prepare,
        ["mine-humanml.lock", "mine-humanml/store.json", "mine-humanml/features.npy"],
    ),
    "text cache": (encode_captions, ["text/model-0123.safetensors"]),
    "sample": (sample, SAMPLES),
    "page": (page, ["player.html"]),
    "any": (any_file, ["part/any.npz"]),
    "any json": (any_json_file, ["lengths/any.json"]),
    "tables": (tables, ["mdm.md", "mdm.tex", "mdm.csv", "mdm.html"]),
    "audit": (audit, ["synthetic-none.html", "synthetic-none.md"]),
    "audit cache": (audit_cache, ["real.npz"]),
    "evaluate": (evaluated_motions, ["0.npz"]),
    "ratings": (ratings, ["ratings.json"]),
    "compare": (compare, ["compare.html"]),
    "report": (report, ["report.html"]),
    "browse": (browse, ["page.html"]),
    "verify": (verify, ["verify.json"]),
    "export": (export, ["model.safetensors"]),
    "runner": (runner_output, ["motion.npz"]),
    "adapt": (adapter, ["mine.safetensors"]),
    "convert": (motion_files, [f"walk{ending}" for ending in CONVERTED]),
}
"""Functions that write into a folder of others, with the names of their files."""

CASES = [(writer, name) for writer, (_, names) in WRITERS.items() for name in names]
FOLDERS = sorted({(writer, name.partition("/")[0]) for writer, name in CASES if "/" in name})


def plant(kind: str, path: Path, victim: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "link":
        path.symlink_to(victim)
    elif kind == "hard link":
        path.hardlink_to(victim)
    else:
        os.mkfifo(path)


def attempt(write: Callable[[Path], None], folder: Path) -> None:
    """The files are written, or refused in one line, within seconds."""

    def late(*_: object) -> None:
        raise AssertionError("it waits for a pipe")

    handler, refusal = signal.signal(signal.SIGALRM, late), str(folder)
    signal.alarm(60)
    try:
        write(folder)
    except (UserError, OSError) as error:
        refusal = str(error)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
    assert str(folder) in refusal
    assert "\n" not in refusal


@pytest.mark.parametrize("writer", WRITERS)
def test_each_writer_writes_its_files_into_a_folder_without_links(tmp_path, writer):
    write, names = WRITERS[writer]
    write(tmp_path)
    lasting = [name for name in names if not name.endswith(".lock")]
    assert [name for name in lasting if not (tmp_path / name).is_file()] == []


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe"])
@pytest.mark.parametrize(("writer", "name"), CASES)
def test_a_link_at_the_name_of_a_file_does_not_lead_to_the_file_of_somebody_else(
    tmp_path, writer, name, kind
):
    victim, folder = tmp_path / "victim", tmp_path / "folder"
    victim.write_bytes(VICTIM)
    plant(kind, folder / name, victim)
    attempt(WRITERS[writer][0], folder)
    assert victim.read_bytes() == VICTIM
    assert sorted(tmp_path.iterdir()) == [folder, victim]
    assert not [path for path in folder.rglob(".*") if path.name.startswith(".")], (
        "nothing half-written stays"
    )


@pytest.mark.parametrize("writer", ["audit cache", "text cache", "evaluate", "prepare", "train"])
def test_a_link_to_a_file_that_does_not_exist_does_not_create_it(tmp_path, writer, subtests):
    write, names = WRITERS[writer]
    for name in names:
        with subtests.test(name=name):
            victim, folder = tmp_path / "victim", tmp_path / name.replace("/", "-")
            (folder / name).parent.mkdir(parents=True)
            (folder / name).symlink_to(victim)
            attempt(write, folder)
            assert not victim.exists()


@pytest.mark.parametrize(("writer", "name"), FOLDERS)
def test_a_link_at_the_name_of_a_folder_does_not_lead_to_the_files_of_somebody_else(
    tmp_path, writer, name
):
    victim, folder = tmp_path / "victim", tmp_path / "folder"
    write, names = WRITERS[writer]
    contents = {Path(file).name for file in names} | {"thesis.doc", "motion_007.npz"}
    victim.mkdir()
    folder.mkdir()
    for file in contents:
        (victim / file).write_bytes(VICTIM)
    (folder / name).symlink_to(victim)
    with one_line_error("a link points outside|is not a prepared data set"):
        write(folder)
    assert {path.name: path.read_bytes() for path in victim.iterdir()} == dict.fromkeys(
        contents, VICTIM
    )


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe"])
def test_libraries_write_into_a_run_only_if_nothing_in_it_leads_elsewhere(tmp_path, kind):
    victim, run = tmp_path / "victim", tmp_path / "run"
    victim.write_bytes(VICTIM)
    plant(kind, run / "csv" / "metrics.csv", victim)
    with one_line_error(r"csv/metrics\.csv: "), only_run(run):
        (run / "csv" / "metrics.csv").write_text("of Lightning")
    assert victim.read_bytes() == VICTIM
    inside = tmp_path / "other"
    (inside / "wandb" / "run-1").mkdir(parents=True)
    (inside / "wandb" / "latest-run").symlink_to("run-1")  # as wandb does
    with only_run(inside):
        pass


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe"])
@pytest.mark.parametrize("name", ["model.json", "runner.py"])
def test_an_export_to_onnx_replaces_links_in_its_folder(tmp_path, monkeypatch, name, kind):
    pytest.importorskip("onnxscript")
    monkeypatch.setattr(onnx_export, "load", lambda *_, **__: None)
    monkeypatch.setattr(onnx_export, "description", lambda _: {"sha256": {}})
    monkeypatch.setattr(onnx_export, "graphs", lambda _: [])
    victim, folder = tmp_path / "victim", tmp_path / "folder"
    victim.write_bytes(VICTIM)
    plant(kind, folder / name, victim)
    onnx_export.export_onnx("model", folder)
    assert victim.read_bytes() == VICTIM
    assert {path.name for path in folder.iterdir()} == {"model.json", "runner.py"}
    assert all(path.is_file() and not path.is_symlink() for path in folder.iterdir())


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe"])
@pytest.mark.parametrize(
    "name", ["multirun.yaml", ".submitit/1_submitted.pkl", "seed=1/config.yaml"]
)
def test_hydra_starts_no_sweep_in_a_folder_that_leads_elsewhere(
    tmp_path, monkeypatch, capsys, name, kind
):
    monkeypatch.setattr(sweeps, "hydra_main", lambda **_: pytest.fail("the sweep has begun"))
    victim, folder = tmp_path / "victim", tmp_path / "folder"
    victim.write_bytes(VICTIM)
    plant(kind, folder / name, victim)
    assert main(["train", "quickstart", "seed=1,2", "--multirun", f"run.dir={folder}"]) == 1
    assert f"error: {folder / name}: " in capsys.readouterr().err
    assert victim.read_bytes() == VICTIM


def test_a_device_is_not_replaced_by_a_file(tmp_path):
    os.mkfifo(tmp_path / "out.html")
    with one_line_error("a pipe, a socket or a device"):
        page_of = tmp_path / "out.html"
        write_player(page_of, [MOTION])
    assert page_of.is_fifo()


def test_prepare_replaces_an_intact_store_only_and_keeps_the_files_of_others(tmp_path):
    folder = tmp_path / "mine-humanml"
    (folder / "clips").mkdir(parents=True)
    (folder / "clips" / "walk.bvh").write_bytes(VICTIM)
    with one_line_error(f"{folder}: exists, but is not a prepared data set"):
        prepare(tmp_path)
    assert (folder / "clips" / "walk.bvh").read_bytes() == VICTIM
    folder.rename(tmp_path / "source")
    prepare(tmp_path)
    (folder / "notes.txt").write_bytes(VICTIM)
    before = (folder / "features.npy").read_bytes()
    write_store(
        folder, OwnClips(clip("b", motion=clip("a").motion[:30])), HumanML("smpl22", "clean")
    )
    assert (folder / "notes.txt").read_bytes() == VICTIM
    assert (folder / "features.npy").read_bytes() != before
    features = (folder / "features.npy").read_bytes()
    (folder / "features.npy").write_bytes(features[:-4] + b"\0\0\0\1")
    with one_line_error(r"features\.npy is damaged: .* Delete .* and prepare"):
        prepare(tmp_path)
    assert (folder / "features.npy").stat().st_size == len(features)


@pytest.mark.parametrize("name", ["*", "../x", "/tmp/x", "..", ".hidden", "a/b", "", "-x"])
def test_the_name_of_a_data_set_names_a_folder_in_the_data_root(
    tmp_path, monkeypatch, capsys, name
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / ".mine.keep").mkdir()
    words = ["prepare", "synthetic", f"data.name='{name}'", "data.source.clips=8", "data_root=data"]
    assert main(words) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: data.name={name}: use a name of letters, digits")
    assert [path.name for path in (tmp_path / "data").iterdir()] == [".mine.keep"]
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_temporary_files_of_living_processes_stay_and_abandoned_ones_go(tmp_path):
    machine, token = paths._machine(), "0123456789abcdef"
    dead = next(number for number in range(99_999, 1, -1) if not Path(f"/proc/{number}").exists())
    names = {
        "alive": f".a.{machine}-{os.getppid()}-{token}.npz",
        "dead": f".a.{machine}-{dead}-{token}.npz",
        "elsewhere": f".a.00000000-{dead}-{token}.npz",
        # In a container, each process may have the same number
        "former": f".b.{machine}-{os.getpid()}-{token}.npz",
        "not ours": ".a.backup-7-old.npz",
    }
    for name in names.values():
        (tmp_path / name).touch()
    (tmp_path / f".c.{machine}-{dead}-{token}").mkdir()
    (tmp_path / f".d.{machine}-{dead}-{token}").symlink_to(tmp_path / names["alive"])
    with paths.temporary_beside(tmp_path / "own.npz") as own:
        own.touch()
        paths.remove_abandoned(tmp_path)
        assert own.exists()
    assert {path.name for path in tmp_path.iterdir()} == {
        names[key] for key in ("alive", "elsewhere", "not ours")
    }
    paths.remove_abandoned(tmp_path, is_locked=True)
    assert {path.name for path in tmp_path.iterdir()} == {names["not ours"]}


def test_abandoned_files_with_long_names_go_and_those_of_other_files_stay(tmp_path):
    """The names of temporary files contain the first 80 characters of the name of the file."""
    machine, token = paths._machine(), "0123456789abcdef"
    dead = next(number for number in range(99_999, 1, -1) if not Path(f"/proc/{number}").exists())
    path = tmp_path / f"{'x' * 100}.npz"
    names = [f".{stem}.{machine}-{dead}-{token}" for stem in ("x" * 80, "x" * 79)]
    for name in (f"{names[0]}.npz", f"{names[0]}.npy", f"{names[1]}.npz"):
        (tmp_path / name).touch()
    with paths.temporary_beside(path) as own:
        own.touch()
        assert own.name.startswith(f".{'x' * 80}.{machine}-{os.getpid()}-")
        assert own.suffix == ".npz"
    paths.remove_abandoned(tmp_path, path)
    assert {file.name for file in tmp_path.iterdir()} == {f"{names[0]}.npy", f"{names[1]}.npz"}


def test_a_folder_that_a_killed_command_left_is_removed_by_the_next_one(tmp_path):
    if not (child := os.fork()):
        with atomic_folder(tmp_path / "out") as made:
            (made / "motion_000.npz").touch()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert [path.name[:5] for path in tmp_path.iterdir()] == [".out."]
    with atomic_folder(tmp_path / "out") as made:
        (made / "motion_000.npz").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_a_killed_command_left_is_removed_by_the_next_write_to_the_folder(tmp_path):
    if not (child := os.fork()):
        with atomic_write(tmp_path / "walk.bvh") as file:
            file.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert [path.name[:6] for path in tmp_path.iterdir()] == [".walk."]
    write_json(tmp_path / "other.json", {})
    assert [path.name for path in tmp_path.iterdir()] == ["other.json"]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_json_file_never_has_numbers_that_json_lacks(number: float, tmp_path: Path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "result.json", {"fid": float(number)})
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_push_overwrites_the_model_file_that_it_wrote_only(tmp_path, trained):
    model = hub.export(trained, tmp_path)
    before = model.read_bytes()
    with one_line_error(r"model\.safetensors: not overwritten because push did not write it"):
        hub.push(trained, "me/walker", tmp_path, upload=False, private=False)
    assert [path.name for path in tmp_path.iterdir()] == ["model.safetensors"]
    assert model.read_bytes() == before
    model.unlink()
    for _ in range(2):
        hub.push(trained, "me/walker", tmp_path, upload=False, private=False)
    model.write_bytes(b"of somebody else")
    with one_line_error("push did not write it"):
        hub.push(trained, "me/walker", tmp_path, upload=False, private=False)
    assert model.read_bytes() == b"of somebody else"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evaluation", "evaluation/synthetic-2"])
def test_an_evaluation_stays_in_the_run(tmp_path, trained, data_root, name, capsys):
    run, victim = tmp_path / "run", tmp_path / "victim"
    victim.mkdir()
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "last.ckpt").write_bytes(trained.read_bytes())
    (run / name).parent.mkdir(parents=True, exist_ok=True)
    (run / name).symlink_to(victim)
    words = [
        f"ckpt={run}",
        "protocol=synthetic",
        "extractor=none",
        "quick=true",
        f"data_root={data_root}",
    ]
    assert main(["evaluate", *words]) == 1
    assert "a link points outside" in capsys.readouterr().err
    assert not list(victim.iterdir())


def test_a_report_replaces_a_link_and_not_the_file_behind_it(tmp_path):
    run, victim = a_run(tmp_path / "run"), tmp_path / "victim"
    victim.write_bytes(VICTIM)
    (run / "report.html").symlink_to(victim)
    assert main(["report", f"runs='{run}'"]) == 0
    assert victim.read_bytes() == VICTIM
    assert not (run / "report.html").is_symlink()


def test_a_lock_is_no_link_but_is_taken_over_from_a_dead_process(tmp_path):
    (tmp_path / "run.lock").write_text("process 7 on here\n")
    with locked(tmp_path / "run.lock", lambda _: None, "") as dead:
        assert re.fullmatch("process 7 on here", dead)
    assert not list(tmp_path.iterdir())


def test_errors_in_an_archive_name_the_archive_and_not_its_unpacked_copy(tmp_path, capsys):
    archive = tmp_path / "motions.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("deep/walk.bvh", "HIERARCHY")
    owner = OwnClips()
    folder = archives.as_folder(archive, owner, lambda _: True)
    say(f"{folder}/walk.bvh: damaged", error=True)
    assert capsys.readouterr().err == f"{archive}/deep/walk.bvh: damaged\n"


def test_an_error_of_a_motion_names_the_file_that_was_typed(tmp_path, capsys, subtests):
    Motion(np.zeros((20, 21, 3), np.float32), 20.0, KIT21).save(tmp_path / "kit.npz")
    for ending in ("bvh", "glb"):
        with subtests.test(ending=ending):
            assert (
                main(["convert", str(tmp_path / "kit.npz"), str(tmp_path / f"out.{ending}")]) == 1
            )
            assert capsys.readouterr().err.startswith(f"error: {tmp_path}/kit.npz: ")
