"""`flame-mdm tables [NAME ...]`: runs missing evaluations and renders tables and figures."""

import os
from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.config import Config, compose_data, instantiate
from flame_mdm.config.options import option
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.records import read_result
from flame_mdm.reporting.page import page, render
from flame_mdm.reporting.tables.build import NOT_VALID, build
from flame_mdm.reporting.tables.format import write
from flame_mdm.reporting.tables.specs import Evaluation, Lengths, evaluations, load_spec, spec_names
from flame_mdm.safe_io import sha256, write_json, write_text
from flame_mdm.safe_io.paths import check_within

INVALID = 3  # exit code if a requested row is not valid


@dataclass(frozen=True, kw_only=True)
class TablesSettings:
    """usage: flame-mdm tables [NAME ...] [evaluate=false] [out=FOLDER]

    Renders tables and figures as Markdown, LaTeX, CSV and HTML. A file in experiments/tables, or a
    file of your own, lists the checkpoints, the protocol and the columns of a table. Checkpoints
    without a result are evaluated first, unless evaluate=false. The same results always produce
    identical files. Exit codes: 0 = success; 1 = invalid input, or an evaluation failed; 3 = the
    tables are written, but a requested row is NOT VALID.
    """

    OBJECTS: ClassVar = ("table",)
    table: list[str] | None = option(
        None, "tables to render: names in experiments/tables, or paths to specs; default: all"
    )
    evaluate: bool = option(True, "run missing evaluations; false = only render existing results")
    out: str = option("runs/tables", "folder for the tables")
    results: str = option("runs/results", "folder of the results")
    device: str | None = option(
        None, "device for the evaluations, such as cpu or cuda; default: cuda if available"
    )
    batch_size: int = option(64, "motions per batch")
    force: bool = option(
        False,
        "generate motions even if the metrics of real motions differ from the values that "
        "the protocol expects; the result is marked as not valid",
    )
    data_root: str = option(
        "", "folder of the prepared data sets; default: the checkpoint's, or FLAME_MDM_DATA"
    )


def main(settings: TablesSettings) -> None:
    """Runs missing evaluations and writes the tables."""
    names = settings.table or spec_names()
    specs = {Path(name).stem: load_spec(name) for name in names}
    results = Path(settings.results)
    failed = evaluate_missing(specs, results, settings) if settings.evaluate else []
    out = Path(settings.out)
    built = {name: build(name, spec, results) for name, spec in specs.items()}
    counts, invalid = {}, []
    for name, table in built.items():
        write(table, out)
        lines = [
            (part, line) for part in table.parts for line in part.lines if line.kind == "measured"
        ]
        counts[name] = f"{sum(not line.state for _, line in lines)} of {len(lines)}"
        say(f"{name}: {counts[name]} rows measured: {out / name}.html, .md, .tex, .csv")
        invalid += [(name, part, line) for part, line in lines if line.state == NOT_VALID]
    for name, part, line in invalid:
        say(
            f"NOT VALID: {name}, {part.name}, {line.label}: {line.facts['not valid because']}",
            error=True,
        )
    if len(specs) > 1:
        write_text(
            out / "index.html", page("Tables", render("index.html", tables=built, measured=counts))
        )
        say(f"all tables: {out / 'index.html'}")
    if failed:
        raise UserError(f"{len(failed)} evaluations failed: {'; '.join(failed)}")
    if invalid:
        raise SystemExit(INVALID)


def evaluate_missing(
    specs: Mapping[str, Config], results: Path, settings: TablesSettings
) -> list[str]:
    """Runs the evaluations whose results are missing or outdated, and counts motion lengths.

    Returns one line per failed evaluation.
    """
    from evaluators.evaluation import evaluate
    from evaluators.evaluation_request import EvaluationRequest
    from evaluators.protocol import protocol_config

    listed: dict[Path, Evaluation] = {}
    shown: dict[Path, set[str]] = {}  # by result file, the values that the tables show
    for part in (part for spec in specs.values() for part in spec["parts"].values()):
        for dataset in part.get("lengths", []):
            count_lengths(dataset, results, settings)
        for _, row in evaluations(part) if "columns" in part else ():
            for evaluation, column in zip(row, part["columns"].values(), strict=True):
                if not evaluation.absent:
                    listed[evaluation.path(results)] = evaluation
                    shown.setdefault(evaluation.path(results), set()).add(column["value"])

    missing = {
        path: evaluation
        for path, evaluation in listed.items()
        if not path.exists() or outdated(path, evaluation, shown[path])
    }
    failed = []
    for number, (path, evaluation) in enumerate(missing.items()):
        say(f"evaluating {number + 1} of {len(missing)}: {evaluation.label}")
        keys = dict(evaluation.keys)
        try:
            check_within(path, results)
            keys.setdefault("multimodality", shows_multimodality(evaluation, shown[path]))
            dotted = [f"{name}={keys.pop(name)}" for name in list(keys) if "." in name]
            nodes = compose_data(keys.pop("data"), dotted) if "data" in keys else {}
            names = ("device", "batch_size", "force", "data_root")
            general = {
                name: value for name in names if (value := getattr(settings, name)) is not None
            }
            if "batch_size" in protocol_config(keys["protocol"]):
                general.pop(
                    "batch_size", None
                )  # protocols that measure time determine the batch size
            evaluate(EvaluationRequest.of(nodes | general | keys | {"out": str(path)}))
        except (UserError, OSError) as error:
            failed.append(f"{evaluation.label}: {first_line(error)}")
            say(f"failed: {failed[-1]}")
    return failed


def shows_multimodality(evaluation: Evaluation, values: Set[str]) -> bool:
    """Returns whether some of the `values` require several motions per prompt.

    Generating these motions takes most of the evaluation time.
    """
    from evaluators.protocol import protocol_config

    several = protocol_config(evaluation.keys["protocol"]).get("multimodality") or {"metrics": {}}
    return any(value.partition("/")[0] in several["metrics"] for value in values)


def outdated(path: Path, evaluation: Evaluation, values: Set[str] = frozenset()) -> bool:
    """Returns whether a result is outdated and its evaluation must be repeated.

    A result is outdated if its checkpoint, extractor or motion files have changed, if SMPL's model
    file has become available, or if it lacks metrics that require several motions per prompt.

    Args:
        path: path of the result file.
        evaluation: the evaluation that a table requires.
        values: names of the values that tables show.
    """
    from evaluators.sources import sample_files, sha256_of_samples
    from flame_mdm.checkpoints.model_files import weights_sha256

    result = read_result(path)
    samples = evaluation.keys.get("from_samples")
    if samples and result.samples_sha256 != sha256_of_samples(sample_files(Path(samples))):
        return True
    was_skipped = "multimodality" in result.changed and "multimodality" not in evaluation.keys
    if was_skipped and shows_multimodality(evaluation, values):
        return True
    if result.stand_in_skeleton and os.environ.get("FLAME_MDM_SMPL"):
        return True
    for used, key in ((result.checkpoint, "ckpt"), (result.extractor, "extractor")):
        file = Path(str(evaluation.keys.get(key)))
        hashed = (
            weights_sha256
            if key == "extractor" and file.suffix in (".ckpt", ".safetensors")
            else sha256
        )
        if file.is_file() and (used is None or used.sha256 != hashed(file)):
            return True
    return False


def count_lengths(dataset: str, results: Path, settings: TablesSettings) -> None:
    """Writes the motion lengths of a data set to `results`.

    If the data set is not prepared, prints a message instead.
    """
    nodes = compose_data(
        dataset, data_root=settings.data_root or os.environ.get("FLAME_MDM_DATA", "data")
    )
    data = instantiate(nodes["data"], representation=instantiate(nodes["representation"]))
    if not (data.folder / "store.json").exists():
        say(
            f"{dataset} is not prepared, so its motion lengths are omitted. Run make prepare DATA={dataset}"
        )
        return
    store = data.open()
    facts = {name: store.info[name] for name in ("fingerprint", "fps", "excluded")}
    counted = Lengths(lengths=sorted(clip.length for clip in store.clips), **facts)
    write_json(
        results / "lengths" / f"{dataset}.json", counted.model_dump(), indent=None, within=results
    )
