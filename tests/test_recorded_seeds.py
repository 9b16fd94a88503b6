"""Values of seeds and noise, as recorded."""

from typing import Any

import pytest
import torch
from support.recorded import Case, cases_of, check, combinations, record

from flame_mdm.seeds import key, seed_generator

NAME = "seeds"


def keys_of_parts() -> Any:
    return {
        str(parts): key(*parts)
        for parts in ((), ("a",), ("a", 0), ("a", 1), (0, "a"), ("a", 1, "b"))
    }


def draws_of_seeds() -> Any:
    draws = []
    for options in combinations(0, 6, seed=(0, 1, 2**31), size=(5, 1000)):
        seed_generator(options["seed"], torch.device("cpu"))
        draws.append((options, torch.randn(options["size"])))
    return draws


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
