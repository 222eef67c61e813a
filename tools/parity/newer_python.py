"""Makes Python 3.11 read LeRobot 0.6, which is written for 3.12: its modules without their lists of type parameters."""

from __future__ import annotations

import re
import sys
from importlib.machinery import SourceFileLoader
from typing import Any

GENERIC = re.compile(r"^(class|def) (\w+)\[([^\]]+)\]\(", re.MULTILINE)


def _with_variables(match: re.Match[str]) -> str:
    kind, name, parameters = match.groups()
    if kind == "class":  # its variables exist in the module
        return f'class {name}(__import__("typing").Generic[{parameters}], '
    variables = [parameter.partition(":")[0].strip() for parameter in parameters.split(",")]
    definitions = [f'{variable} = __import__("typing").TypeVar("{variable}")\n' for variable in variables]
    return f"{''.join(definitions)}def {name}("


def _prepare() -> None:
    compiled = SourceFileLoader.source_to_code

    def without(self: SourceFileLoader, data: Any, path: Any, **options: Any) -> Any:
        if "lerobot" in str(path):
            data = GENERIC.sub(_with_variables, bytes(data).decode()).encode()
        return compiled(self, data, path, **options)

    SourceFileLoader.source_to_code = without


if sys.version_info < (3, 12):
    _prepare()
