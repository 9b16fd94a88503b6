"""Measures the speed of the framework and writes docs/benchmarks/speed.md: `make bench [ONLY=a,b] [DEVICE=cuda]`.

The scripts run one after another, each in its own process. ONLY selects sections; all other
sections keep their figures. DEVICE=cuda measures the sections that use a GPU and adds them to the
page. MDM_REPO=PATH, the path of a clone of the authors' code, adds the authors' training step.
ONLY=quality RUNS=FOLDER compares the quality of trained runs.
"""

import datetime
import importlib
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from sections import Settings, body

from flame_mdm.training.provenance import environment

PAGE = Path(__file__).parent.parent / "docs" / "benchmarks" / "speed.md"
SECTIONS = (
    "steps",
    "host",
    "averaging",
    "sampling",
    "evaluation",
    "loading",
    "features",
    "text",
    "processes",
    "startup",
    "preparation",
)
ON_GPU = ("steps", "sampling")
ON_REQUEST = ("quality",)  # requires trained models
HEAD = """# Speed

`make bench` measures the speed of the framework and writes this page and [speed.json](speed.json). Every comparison is
a ratio of times that were measured in turns in one run. The machine was idle unless the section states otherwise. The
absolute figures next to each ratio hold only for that machine. `make bench ONLY=host,steps` repeats only these two
sections, and `make bench DEVICE=cuda` adds the sections that are measured on a GPU. If `MDM_REPO` is the path of a
clone of the authors' code, their training step is also measured. A section that names a commit has not been measured
again since that commit. [Speed of training](../speed.md) explains which options to choose.
"""


def machine() -> dict[str, str | int]:
    """Returns the properties of the hardware and the software versions that affect the measurements."""
    capabilities, software = torch.cpu.get_capabilities(), environment()
    has_affinity = hasattr(os, "sched_getaffinity")
    bfloat16 = [name for name in ("avx512_bf16", "amx_bf16") if capabilities.get(name)]
    facts: dict[str, str | int] = {
        "processor": capabilities.get("cpu_name") or platform.processor(),
        "cores": len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1,
        "bfloat16 instructions": " ".join(bfloat16) or "none",
        "threads": torch.get_num_threads(),
        "torch": software["packages"]["torch"],
        "lightning": software["packages"]["lightning"],
        "python": software["python"],
    }
    if torch.cuda.is_available():
        facts["GPU"] = torch.cuda.get_device_name()
    return facts


def run(name: str, settings: Settings) -> dict[str, Any]:
    """Measures a section in a separate process and returns the section."""
    part = PAGE.with_suffix(f".{name}.part")
    line = [sys.executable, __file__, "--child", name, str(part), json.dumps(asdict(settings))]
    try:
        finished = subprocess.run(line, capture_output=True, text=True, check=False)
        if finished.returncode:
            raise SystemExit(f"{finished.stdout}{finished.stderr}\nbenchmarks/{name}.py failed")
        return json.loads(part.read_text())
    finally:
        part.unlink(missing_ok=True)


def child(name: str, out: str, settings: str) -> None:
    """Measures one section and writes it to a JSON file."""
    section = importlib.import_module(name).measure(Settings(**json.loads(settings)))
    Path(out).write_text(json.dumps(section))


def render(sections: dict[str, Any]) -> str:
    """Returns the page with all measured sections, as Markdown."""
    order = sorted(sections, key=_position)
    machines = list(dict.fromkeys(json.dumps(sections[name]["machine"]) for name in order))

    lines = [HEAD, "## In short\n"]
    lines += [f"- {sections[name]['summary']}" for name in order]

    lines.append("\n## Machine\n")
    for number, facts in enumerate(machines, 1):
        lines.append(
            f"{number}. " + ", ".join(f"{key}: {value}" for key, value in json.loads(facts).items())
        )

    for name in order:
        section = sections[name]
        number = machines.index(json.dumps(section["machine"])) + 1
        script = section.get("script", f"benchmarks/{name.removesuffix('_cuda')}.py")
        title = section["title"] + (" on a GPU" if name.endswith("_cuda") else "")
        lines += [
            f"\n## {title}\n",
            body(section),
            f"\nMeasured by `{script}` on {section['date']}, on machine {number}.",
        ]
    return "\n".join(lines) + "\n"


def _position(name: str) -> tuple[int, bool]:
    """Returns the sort key of a section: sections are in the order of `SECTIONS`, first CPU, then GPU."""
    scripts = [*SECTIONS, *ON_REQUEST]
    return scripts.index(name.removesuffix("_cuda")), name.endswith("_cuda")


def chosen(only: str, settings: Settings) -> list[str]:
    """Returns the names of the scripts to run.

    Exits with a one-line error if a script does not exist, or if a GPU, a clone or a folder that it
    requires is missing.
    """
    if settings.device not in ("cpu", "cuda"):
        raise SystemExit(
            f"DEVICE={settings.device}: unknown device. Use cpu, or cuda on a machine with a CUDA GPU"
        )
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("DEVICE=cuda: torch finds no CUDA GPU on this machine")
    if settings.mdm_repo and not (Path(settings.mdm_repo) / "model" / "mdm.py").is_file():
        raise SystemExit(
            f"MDM_REPO={settings.mdm_repo}: contains no model/mdm.py. Use the path of a clone of the authors' code"
        )

    usual = ON_GPU if settings.device == "cuda" else SECTIONS
    possible = [*usual, *ON_REQUEST]
    names: list[str] = only.split(",") if only else list(usual)
    unknown = [name for name in names if name not in possible]
    if unknown:
        raise SystemExit(
            f"ONLY={','.join(unknown)}: no such section. Use one of {', '.join(possible)}"
        )
    if "quality" in names and not settings.runs:
        raise SystemExit(
            "ONLY=quality: requires RUNS=..., a folder with trained and evaluated runs"
        )
    return names


def main(*words: str) -> None:
    """Measures the selected sections, and rewrites the page after each section."""
    options = dict(word.split("=", 1) for word in words)
    settings = Settings(
        device=options.get("device") or "cpu",
        mdm_repo=options.get("mdm_repo") or None,
        runs=options.get("runs") or None,
    )
    names = chosen(options.get("only", ""), settings)
    data = PAGE.with_suffix(".json")
    sections: dict[str, Any] = json.loads(data.read_text()) if data.exists() else {}

    begin = time.perf_counter()
    for number, name in enumerate(names, 1):
        print(f"{number}/{len(names)} {name}", flush=True)
        start = time.perf_counter()
        section = run(name, settings) | {
            "date": datetime.date.today().isoformat(),
            "machine": machine(),
        }
        sections[name + ("_cuda" if settings.device == "cuda" else "")] = section
        data.write_text(json.dumps(sections, indent=1) + "\n")
        PAGE.write_text(render(sections))
        print(f"    {section['summary']} ({time.perf_counter() - start:.0f} s)", flush=True)
    print(f"page: {PAGE} ({(time.perf_counter() - begin) / 60:.1f} minutes)")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(*sys.argv[2:])
    else:
        main(*sys.argv[1:])
