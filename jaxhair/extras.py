"""Packages that only a part of the work needs, which the extras of the installation bring."""

import importlib
from typing import Any

WHO = {"pictures": "pictures need", "posterior": "the posterior needs", "usd": "USD files need"}
"""By the extra's name."""


def optional(module: str, extra: str = "pictures") -> Any:
    """A module of an extra's package. Raises ImportError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ImportError(f'{WHO[extra]} {package}: pip install "jaxhair[{extra}]"') from error
