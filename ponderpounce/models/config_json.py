"""Nested frozen dataclasses from JSON, strictly: an unknown or absent name is an error, not a default.

Writing needs no code: `dataclasses.asdict` and `json.dumps`.
"""

import dataclasses
import typing
from typing import Any, TypeVar

Record = TypeVar("Record")


def from_json(kind: type[Record], values: Any, where: str) -> Record:
    """Builds ``kind`` from parsed JSON; ``where`` names the place in errors.

    Every field must be there: a file must not change its meaning when a default does.

    Raises:
        ValueError: a field is missing or unknown, or the record's own checks refuse a value.
    """
    if not dataclasses.is_dataclass(kind):
        raise TypeError(f"{kind} is no dataclass")
    names = {field.name for field in dataclasses.fields(kind)}
    if not isinstance(values, dict) or values.keys() != names:
        came = values.keys() if isinstance(values, dict) else set()
        raise ValueError(f"{where}: missing {sorted(names - came)}, unknown {sorted(came - names)}")
    hints = typing.get_type_hints(kind)
    return kind(**{name: _value(hints[name], values[name], f"{where}.{name}") for name in names})


def _value(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_json(typing.cast(type[Any], hint), value, where)
    return tuple(value) if typing.get_origin(hint) is tuple else value
