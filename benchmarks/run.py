"""Runs the benchmarks and writes docs/benchmarks/speed.md: `python benchmarks/run.py [only=a,b] [device=cuda]`.

Each benchmark runs in a process, one after another. With `only`, the other sections keep their figures. `device=cuda`
adds the sections of a GPU to the page. Sections that were measured once, by a script of an earlier commit, stay.
"""

import datetime
import importlib
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from sections import body

from flame_mdm.training.provenance import environment

PAGE = Path(__file__).parent.parent / "docs" / "benchmarks" / "speed.md"
SECTIONS = ["steps", "sampling"]
HEAD = """# Speed

`make bench` measures the speed of the framework and writes this page and [speed.json](speed.json). Every comparison is
a ratio of two measurements in one run, on an idle machine unless the section says otherwise; the absolute figures next
to it hold for that machine alone. `make bench ONLY=steps` repeats some sections, `make bench DEVICE=cuda` adds those
of a GPU. Sections that name a commit were measured once, by a script of that commit.
[Which options to choose](../speed.md) is a page of its own.
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


def child(name: str, out: str, *words: str) -> None:
    Path(out).write_text(json.dumps(importlib.import_module(name).measure(*words)))


def run(name: str, *words: str) -> dict[str, Any]:
    out = PAGE.with_suffix(f".{name}.part")
    try:
        line = [sys.executable, __file__, "--child", name, str(out), *words]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{done.stdout}{done.stderr}\nbenchmarks/{name}.py failed")
        return json.loads(out.read_text())
    finally:
        out.unlink(missing_ok=True)


def render(sections: dict[str, Any]) -> str:
    order = sorted(sections, key=lambda name: ("script" in sections[name], name.endswith("_cuda"), _rank(name)))
    machines = list(dict.fromkeys(json.dumps(sections[name]["machine"]) for name in order))
    lines = [HEAD, "## In short\n", *(f"- {sections[name]['summary']}" for name in order), "\n## Machine\n"]
    for number, facts in enumerate(machines, 1):
        lines.append(f"{number}. " + ", ".join(f"{key}: {value}" for key, value in json.loads(facts).items()))
    for name in order:
        section = sections[name]
        where = machines.index(json.dumps(section["machine"])) + 1
        script = section.get("script", f"benchmarks/{name.removesuffix('_cuda')}.py")
        title = section["title"] + " on a GPU" * name.endswith("_cuda")
        lines += [f"\n## {title}\n", body(section), f"\n`{script}`, {section['date']}, machine {where}."]
    return "\n".join(lines) + "\n"


def _rank(name: str) -> int:
    name = name.removesuffix("_cuda")
    return SECTIONS.index(name) if name in SECTIONS else len(SECTIONS)


def main(*words: str) -> None:
    options = dict(word.split("=", 1) for word in words)
    device = options.get("device") or "cpu"
    if device not in ("cpu", "cuda"):
        raise SystemExit(f"DEVICE={device}: give cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("DEVICE=cuda: torch finds no CUDA GPU on this machine")
    chosen = options["only"].split(",") if options.get("only") else SECTIONS
    if unknown := [name for name in chosen if name not in SECTIONS]:
        raise SystemExit(f"ONLY={','.join(unknown)}: give some of {', '.join(SECTIONS)}")
    data = PAGE.with_suffix(".json")
    sections: dict[str, Any] = json.loads(data.read_text()) if data.exists() else {}
    for number, name in enumerate(chosen, 1):
        print(f"{number}/{len(chosen)} {name}", flush=True)
        start = time.perf_counter()
        section = run(name, *(["--device", "cuda"] if device == "cuda" else []))
        section |= {"date": datetime.date.today().isoformat(), "machine": machine()}
        sections[name + "_cuda" * (device == "cuda")] = section
        data.write_text(json.dumps(sections, indent=1) + "\n")
        PAGE.write_text(render(sections))
        print(f"    {section['summary']} ({time.perf_counter() - start:.0f} s)", flush=True)
    print(f"page: {PAGE}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(*sys.argv[2:])
    else:
        main(*sys.argv[1:])
