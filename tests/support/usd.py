"""USD files, opened and validated by usd-core; tests skip if it is not installed."""

from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


def pxr(name: str) -> Any:
    """A module of usd-core, whose modules have no types."""
    pytest.importorskip("pxr", reason="usd-core is not installed: pip install flame-mdm[usd]")
    module: ModuleType = import_module(f"pxr.{name}")
    return module


def opened(path: Path) -> Any:
    """The stage of a file in which no validator of usd-core finds an error."""
    validation, stage = pxr("UsdValidation"), pxr("Usd").Stage.Open(str(path))
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    errors = validation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    return stage
