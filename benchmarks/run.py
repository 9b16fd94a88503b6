"""Runs the benchmark and writes docs/benchmarks/speed.md: `python benchmarks/run.py [cuda]`.

The section of a GPU is next to that of the CPU. Sections that were measured once, by a script of an earlier commit,
keep their figures.
"""

import datetime
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

import torch

from flame_mdm.training.provenance import environment

Row = dict[str, str | float | None]
Section = dict[str, Any]  # a title, a text, a summary in one sentence, and tables by caption

PAGE = Path(__file__).parent.parent / "docs" / "benchmarks" / "speed.md"
HEAD = """# Speed

`make bench` measures the speed of training steps and writes this page and [speed.json](speed.json). Every comparison is
a ratio of two measurements in one run, on an idle machine unless the section says otherwise; the absolute figures next
to it hold for that machine alone. `make bench DEVICE=cuda` adds the section of a GPU. Sections that name a commit were
measured once, by a script of that commit. [Which options to choose](../speed.md) is a page of its own.
"""


def machine() -> dict[str, str | int]:
    has, software = torch.cpu.get_capabilities(), environment()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    facts: dict[str, str | int] = {
        "processor": has.get("cpu_name") or platform.processor(),
        "cores": cores,
        "bfloat16 instructions": " ".join(name for name in ("avx512_bf16", "amx_bf16") if has.get(name)) or "none",
        "threads": torch.get_num_threads(),
        "torch": software["packages"]["torch"],
        "lightning": software["packages"]["lightning"],
        "python": software["python"],
    }
    if torch.cuda.is_available():
        facts["GPU"] = torch.cuda.get_device_name()
    return facts


def cell(value: str | float | None) -> str:
    """Returns text with three significant digits."""
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:,.0f}" if abs(value) >= 100 or value == round(value) else f"{value:#.3g}".rstrip(".")


def table(rows: list[Row]) -> str:
    lines = [list(rows[0]), ["---", *["---:"] * (len(rows[0]) - 1)], *([cell(v) for v in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def render(sections: dict[str, Any]) -> str:
    order = sorted(sections, key=lambda name: ("script" in sections[name], name.endswith("_cuda")))
    machines = list(dict.fromkeys(json.dumps(sections[name]["machine"]) for name in order))
    lines = [HEAD, "## In short\n", *(f"- {sections[name]['summary']}" for name in order), "\n## Machine\n"]
    for number, facts in enumerate(machines, 1):
        lines.append(f"{number}. " + ", ".join(f"{key}: {value}" for key, value in json.loads(facts).items()))
    for name in order:
        section = sections[name]
        where = machines.index(json.dumps(section["machine"])) + 1
        script = section.get("script", "benchmarks/steps.py")
        title = section["title"] + (" on a GPU" if name.endswith("_cuda") else "")
        lines += [f"\n## {title}\n", section["text"]]
        lines += [f"\n{name[:1].upper()}{name[1:]}:\n\n{table(rows)}" for name, rows in section["tables"].items()]
        lines.append(f"\n`{script}`, {section['date']}, machine {where}.")
    return "\n".join(lines) + "\n"


def main(device: str = "cpu") -> None:
    import steps

    if device not in ("cpu", "cuda") or (device == "cuda" and not torch.cuda.is_available()):
        raise SystemExit(f"DEVICE={device}: give cpu, or cuda on a machine with a CUDA GPU")
    data = PAGE.with_suffix(".json")
    sections: dict[str, Any] = json.loads(data.read_text()) if data.exists() else {}
    section = steps.measure(device) | {"date": datetime.date.today().isoformat(), "machine": machine()}
    sections["steps_cuda" if device == "cuda" else "steps"] = section
    data.write_text(json.dumps(sections, indent=1) + "\n")
    PAGE.write_text(render(sections))
    print(f"{section['summary']}\npage: {PAGE}")


if __name__ == "__main__":
    main(*sys.argv[1:])
