"""Nested frozen dataclasses from JSON: an absent name takes the record's default, an unknown one is an error.

Defaults are the paper's values and do not change, so a field that is added later keeps older files valid.
Writing needs no code: `dataclasses.asdict` and `json.dumps`.
"""

import dataclasses
import sys
import types
import typing
from typing import Any, TypeVar

Record = TypeVar("Record")


def from_json(kind: type[Record], values: Any, where: str) -> Record:
    """Builds ``kind`` from parsed JSON; ``where`` names the source in errors.

    Fields may be numbers, strings, booleans, Literals, unions, homogeneous tuples, records of these, and tuples of such
    records.

    Raises:
        ValueError: a field without a default is missing, a name is unknown, a value has another type or is no finite
            number, or the record's own checks refuse it.
    """
    if not dataclasses.is_dataclass(kind):
        raise TypeError(f"{kind} is no dataclass")
    if not isinstance(values, dict):
        raise ValueError(f"{where}: expected an object, came {values!r}")
    fields = dataclasses.fields(kind)
    needed = {each.name for each in fields if each.default is each.default_factory is dataclasses.MISSING}
    missing, unknown = sorted(needed - values.keys()), sorted(values.keys() - {each.name for each in fields})
    if missing or unknown:
        raise ValueError(f"{where}: missing {missing}, unknown {unknown}")
    hints = typing.get_type_hints(kind)
    return kind(**{name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()})


def deviations(record: Any) -> dict[str, Any]:
    """The fields of a record that differ from their defaults. Digests are taken over these, so that adding a field
    changes no digest."""
    found = {}
    for each in dataclasses.fields(record):
        value = getattr(record, each.name)
        default = each.default_factory() if each.default_factory is not dataclasses.MISSING else each.default
        if value != default:
            found[each.name] = deviations(value) if dataclasses.is_dataclass(value) else value
    return found


def is_finite(number: int | float) -> bool:
    """Whether a number is one that a float holds: JSON and TOML also have NaN, infinity and integers beyond floats."""
    return abs(number) <= sys.float_info.max


def _value(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_json(typing.cast(type[Any], hint), value, where)
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType) and value is not None and len(set(args) - {types.NoneType}) == 1:
        return _value(next(arg for arg in args if arg is not types.NoneType), value, where)
    if origin is tuple and isinstance(value, list):
        kinds = args[:1] * len(value) if args[1:] == (...,) else args
        if len(kinds) != len(value):
            raise ValueError(f"{where}: expected {len(kinds)} values, came {value!r}")
        pairs = enumerate(zip(kinds, value, strict=True))
        return tuple(_value(kind, item, f"{where}[{index}]") for index, (kind, item) in pairs)
    if not _fits(hint, value):
        expected = " or ".join(map(repr, args)) if origin is typing.Literal else getattr(hint, "__name__", hint)
        raise ValueError(f"{where}: expected {expected}, came {value!r}")
    if isinstance(value, int | float) and not is_finite(value):
        raise ValueError(f"{where}: expected a finite number, came {value!r:.40}")
    return value


def _fits(hint: Any, value: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return value in args
    if origin in (typing.Union, types.UnionType):
        return any(_fits(arg, value) for arg in args)
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    return origin is None and isinstance(value, hint)
