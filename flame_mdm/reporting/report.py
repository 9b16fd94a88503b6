"""Single-page HTML report of a training run."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from flame_mdm.records import Result, Value
from flame_mdm.reporting.page import interval, number, page, render
from flame_mdm.reporting.plots import Curve, chart
from flame_mdm.runs import FAULT, HISTORY, Fault, Provenance, Run, read_run
from flame_mdm.safe_io import write_text
from flame_mdm.schemas import read_json

if TYPE_CHECKING:
    from markupsafe import Markup

    from flame_mdm.visualize.body import Mesh

COST = ("lr", "grad_norm", "samples_per_second", "seconds_per_step", "gpu_memory_gib")
"""Training curves that show speed and optimization instead of losses."""


def write_report(folder: Path, mesh: Mesh | None = None) -> Path:
    """Writes `report.html` into a run directory and returns its path.

    The same run always yields the same bytes.
    """
    from omegaconf import OmegaConf

    run = read_run(folder)
    fault: Fault | None = None
    if (folder / FAULT).exists():
        fault = read_json(folder / FAULT, Fault, "delete it to write the page without it")
    faulty = (
        [[f"process {b.rank}, batch {b.batch}", b.loss, ", ".join(b.ids)] for b in fault.batches]
        if fault
        else []
    )
    groups = {
        heading: [_chart(run, name, families) for name, families in titles.items()]
        for heading, titles in charted(run.curves).items()
    }
    body = render(
        "report.html",
        run=run,
        facts=_facts(run),
        fault=fault,
        faulty=faulty,
        player=_player(run, mesh),
        step=int(run.samples.name.removeprefix("step_")) if run.samples else 0,
        evaluations=[_evaluation(result) for result in run.results.values()],
        groups=groups,
        history=HISTORY,
        provenance=_provenance(run.provenance) if run.provenance else [],
        recipe=OmegaConf.to_yaml(OmegaConf.create(run.config)),
    )
    path = folder / "report.html"
    write_text(path, page(run.label, body))
    return path


def last(curve: Curve) -> float | None:
    """Returns the value at the last step of a curve, or None if the curve is empty."""
    return curve[max(curve)] if curve else None


def _facts(run: Run) -> list[str]:
    facts = [f"step {run.steps:,} of {run.config['trainer']['max_steps']:,}"]
    if (epochs := last(run.curves.get("train/epochs", {}))) is not None:
        facts.append(f"{number(epochs)} passes over the data")
    if run.provenance and run.provenance.parameters is not None:
        facts.append(f"{run.provenance.parameters / 1e6:.2f} M parameters")
    if (seconds := last(run.curves.get("train/seconds_per_step", {}))) is not None:
        facts.append(f"{seconds:.3g} s/step")
    return facts + ([run.provenance.device] if run.provenance else [])


def _player(run: Run, body: Mesh | None) -> str:
    if run.samples is None:
        return ""
    from flame_mdm.formats.readers import read
    from flame_mdm.visualize import player_page

    # The player is generated again from the motions, because the existing `player.html` may be
    # untrusted and its scripts would run in the report.
    return player_page([read(path) for path in sorted(run.samples.glob("motion_*.npz"))], body=body)


def _chart(run: Run, name: str, families: list[str]) -> Markup:
    lines: dict[str, Curve] = {family: run.curves[f"{family}/{name}"] for family in families}
    for family in families:
        if real := run.curves.get(f"{family}/{name}/real"):
            lines["real motions"] = real
    return chart(
        name, lines, {family: run.curves.get(f"{family}/{name}/ci", {}) for family in families}
    )


def charted(curves: Collection[str]) -> dict[str, dict[str, list[str]]]:
    """Groups curves by heading and, under each heading, by chart.

    Curves whose names differ only in their family (`train/loss`, `val/loss`) share a chart.
    """
    samples = "Samples for the fixed prompts"
    groups: dict[str, dict[str, list[str]]] = {
        "Losses": {},
        "Validation": {},
        samples: {},
        "Training curves": {},
    }
    for name in curves:
        family, _, rest = name.partition("/")
        # "" = a name without a family, which runs do not write
        if rest.endswith(("/ci", "/real")) or rest in (
            "",
            "epochs",
        ):
            continue
        heading = {"samples": samples, "val": "Validation"}.get(family, "Training curves")
        if f"train/{rest}" in curves and rest not in COST:
            heading = "Losses"
        groups[heading].setdefault(rest, []).append(family)
    return {title: {n: sorted(g[n]) for n in sorted(g)} for title, g in groups.items() if g}


def _evaluation(result: Result) -> tuple[object, ...]:
    values, real = result.values or {}, result.ground_truth or {}
    rows = [
        [
            labeled(name, values.get(name) or real.get(name)),
            printed(real.get(name)),
            printed(values.get(name)),
        ]
        for name in sorted(values | real)
    ]
    audit = "evaluator not audited"
    if result.audit:
        audit = f"audit of the evaluator: {result.audit}"
        audit += f", of {result.audit_motions} motions" if result.audit_motions else ""
    return (
        evaluation_title(result),
        f"{sampling(result)}; {audit}",
        marks(result),
        result.not_computed,
        rows,
    )


def evaluation_title(result: Result) -> str:
    """Returns the heading of a result: protocol, data, split and extractor."""
    measured = f", extractor {result.extractor.sha256[:8]}" if result.extractor else ""
    protocol, data = result.protocol, result.data
    return f"{protocol.name} version {protocol.version}, {data.dataset} {result.split}{measured}"


def labeled(name: str, value: Value | None) -> str:
    """Returns the name of a metric, followed by its unit if it has one."""
    return f"{name} ({value.unit})" if value and value.unit else name


def sampling(result: Result) -> str:
    """Returns the origin of a result's motions: the checkpoint or baseline, and the sampler options."""
    checkpoint = result.checkpoint
    words = [f"baseline {result.baseline}" if result.baseline else "motions from other systems"]
    if checkpoint is not None:
        words = [
            f"{Path(checkpoint.path).name} ({checkpoint.sha256[:8]})",
            f"{checkpoint.sampler}, {checkpoint.num_inference_steps} steps",
            f"guidance {checkpoint.guidance_scale:g}",
            f"seed {result.seed}",
        ]
    if result.counts:
        words.append(f"replications x motions: {result.counts}")
    if result.cost and result.cost.seconds_per_sample is not None:
        words.append(f"{result.cost.seconds_per_sample:.3g} seconds per motion on {result.device}")
        if result.cost.batch_size:
            words.append(f"batches of {result.cost.batch_size:g}")
    return ", ".join(words)


def marks(result: Result) -> list[str]:
    """Returns the reasons not to publish a result, and its differences from the protocol."""
    reasons = ["Quick run — not for publication"] if result.quick else []
    reasons += [f"not valid: {reason}" for reason in result.invalid_because]
    changed = ", ".join(f"{name} {value}" for name, value in result.changed.items())
    return reasons + (
        [f"differs from the protocol: {changed}"] if changed and not result.quick else []
    )


def printed(value: Value | None) -> str:
    """Formats a value with its interval, or a missing value as a dash."""
    return interval(value.mean, value.half) if value else "–"


def _provenance(facts: Provenance) -> list[list[str]]:
    changed = " with uncommitted changes" if facts.changed else ""
    return [
        ["command", " ".join(facts.command)],
        ["commit", (facts.commit or "not from a clone") + changed],
        [
            "data",
            ", ".join(
                f"{k} {v}"
                for k, v in facts.data.model_dump(exclude_unset=True).items()
                if k != "actions"
            ),
        ],
        ["device", facts.device],
        ["machine", f"{facts.machine}, Python {facts.python}"],
        ["packages", ", ".join(f"{name} {version}" for name, version in facts.packages.items())],
    ]
