"""For pyright, which takes most of a minute to read the package's list of models."""

from typing import Any

def __getattr__(name: str) -> Any: ...
