"""Computes the FID and R-precision of a model with the evaluator in the package."""

from pathlib import Path

from flame_mdm.__main__ import main
from flame_mdm.safe_io import read_json

RESULT = Path("examples_output/08_evaluate/result.json")
DATA = ["data_root=examples_output/08_evaluate/data", "data.source.clips=700"]


def run(*words: str) -> None:
    if code := main([*words, *DATA]):
        raise SystemExit(code)


if __name__ == "__main__":  # data sets are prepared by processes that import this file
    run("prepare", "synthetic", "force=true")

    # quick=true only checks that everything works: it evaluates two replications of 64 motions.
    # The result is marked as quick.
    run(
        "evaluate",
        "quickstart",
        "data=synthetic",
        "quick=true",
        "multimodality=false",
        f"out={RESULT}",
    )

    values = read_json(RESULT)["values"]
    for name, value in sorted(values.items()):
        if value is not None and value["mean"] is not None:
            print(name, f"{value['mean']:.3f}", "of", value["n"], "motions")
