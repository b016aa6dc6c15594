"""Configurations: nested frozen dataclasses to dictionaries and back, overrides, hashes, checks.

A field is an int, float, bool, str, a tuple of these, an optional one of these, or another such
dataclass. Dictionaries hold what JSON holds, so `json.loads(json.dumps(to_dict(c))) == to_dict(c)`.
"""

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

from represent_jax.errors import SettingError, UsageError, unknown

C = TypeVar("C")

_BOOLS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def require(condition: bool, field: str, expected: str, found: Any) -> None:
    """Raises a SettingError naming the field, what it has to be and what it is, unless it holds.

    Args:
        condition: whether the field is as it has to be.
        field: the field's name.
        expected: what the field has to be, in words, for example "a positive int".
        found: the value it has.

    Raises:
        SettingError: the condition does not hold.
    """
    if not condition:
        raise SettingError(field, f"expected {expected}, found {found!r}")


def require_sizes(sizes: tuple[int, ...], field: str = "hidden_sizes") -> None:
    """Raises a SettingError unless every layer has units."""
    require(all(size >= 1 for size in sizes), field, "each at least 1", sizes)


def require_indices(entries: tuple[int, ...], field: str) -> None:
    """Raises a SettingError unless all can be entries of an observation, of whatever size."""
    require(all(entry >= 0 for entry in entries), field, "indices from 0", entries)


def require_entries(entries: tuple[int, ...], obs_dim: int, field: str) -> None:
    """Raises a SettingError unless an observation of this size has all the entries."""
    expected = f"indices of an observation of size {obs_dim}"
    require(all(0 <= entry < obs_dim for entry in entries), field, expected, entries)


def to_dict(config: Any) -> dict[str, Any]:
    """Returns the configuration as nested dictionaries that JSON can hold (tuples become lists)."""
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def from_dict(cls: type[C], values: Mapping[str, Any]) -> C:
    """Builds a configuration from nested dictionaries; fields left out take their defaults.

    Args:
        cls: the dataclass to build.
        values: what `to_dict` returns, or a part of it.

    Raises:
        UsageError: a key is unknown, a field without a default is missing, a value has the wrong
            type, or the dataclass' own checks refuse it.
    """
    return _build(cls, values, prefix="")


def restore(cls: type[C], values: Mapping[str, Any]) -> C:
    """Builds a configuration that was kept: what came later is at what was done before it.

    Args:
        cls: the dataclass to build.
        values: what `to_dict` returned, in this version or in one before.

    Raises:
        UsageError: as `from_dict`.
    """
    return from_dict(cls, _with_before(cls, values))


def apply_overrides(config: C, overrides: Sequence[str]) -> C:
    """Returns the configuration with `dotted.key=value` settings applied, all of them at once.

    A value is read by the type of its field: `1e-3`, `100_000`, `true`, `none`, `256,256`.

    Raises:
        UsageError: a setting has no `=`, names no field, or its value does not fit the field.
    """
    values = to_dict(config)
    hints = dict(_leaves(type(config)))
    for override in overrides:
        key, equals, text = override.partition("=")
        key = key.strip()
        if not equals:
            raise UsageError(f"override {override!r}: expected key=value")
        if key not in hints:
            inner = [name for name in hints if name.startswith(f"{key}.")]
            if inner:
                raise UsageError(f"{key} is a group of settings: set one of {', '.join(inner)}")
            raise unknown("setting", key, hints)
        *groups, name = key.split(".")
        place = values
        for group in groups:
            if place[group] is None:
                place[group] = {}
            place = place[group]
        place[name] = _parse(text.strip(), hints[key], key)
    return from_dict(type(config), values)


_SAME = object()


def later(default: Any, before: Any = _SAME) -> Any:
    """A field that came after results were kept: at what was before, `identity` is as it was.

    Args:
      default: the field's default.
      before: the value that does what was done before the field existed; the default if not given.
    """
    return dataclasses.field(
        default=default, metadata={"before": default if before is _SAME else before}
    )


def identity(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what tells settings apart: a mapping that may hold configurations, as `to_dict`.

    Fields made by `later` are left out at the value that does what was done before them, so that
    results kept before the field existed are found again.
    """
    return {name: _identity(value) for name, value in values.items()}


def config_hash(config: Any) -> str:
    """Returns twelve hexadecimal digits, equal for equal configurations; see `identity`."""
    values = identity(config) if isinstance(config, Mapping) else _identity(config)
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


def diff(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Returns the dotted keys whose values differ, or that only one of the dictionaries has."""
    keys = []
    for key in dict.fromkeys([*a, *b]):
        if key not in a or key not in b:
            keys.append(key)
        elif isinstance(a[key], Mapping) and isinstance(b[key], Mapping):
            keys += [f"{key}.{inner}" for inner in diff(a[key], b[key])]
        elif _plain(a[key]) != _plain(b[key]):
            keys.append(key)
    return keys


def _identity(value: Any) -> Any:
    if isinstance(value, Mapping):
        return identity(value)
    if not dataclasses.is_dataclass(value):
        return _plain(value)
    held = {field: getattr(value, field.name) for field in dataclasses.fields(value)}
    return {
        field.name: _identity(one)
        for field, one in held.items()
        if not ("before" in field.metadata and one == field.metadata["before"])
    }


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value


def _with_before(cls: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Fills in fields made by `later` that the values do not have yet."""
    hints, filled = typing.get_type_hints(cls), dict(values)
    for field in dataclasses.fields(cls):
        inner, _ = _optional(hints[field.name])
        held = values.get(field.name)
        if field.name not in values and "before" in field.metadata:
            filled[field.name] = _plain(field.metadata["before"])
        elif dataclasses.is_dataclass(inner) and isinstance(held, Mapping):
            filled[field.name] = _with_before(inner, held)
    return filled


def _optional(hint: Any) -> tuple[Any, bool]:
    """Splits `X | None` into (X, True); any other annotation X is (X, False)."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        others = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        if len(others) == 1:
            return others[0], True
    return hint, False


def _item_hints(hint: Any, length: int) -> tuple[Any, ...] | None:
    """Returns the annotation of each item of a tuple, None if the tuple cannot have that length."""
    args = typing.get_args(hint)
    if len(args) == 2 and args[1] is Ellipsis:
        return (args[0],) * length
    return args if len(args) == length else None


def _leaves(cls: type, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the dotted key and the annotation of every field that is not itself a dataclass."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        inner, _ = _optional(hints[field.name])
        if dataclasses.is_dataclass(inner):
            yield from _leaves(inner, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, hints[field.name]


def _describe(hint: Any) -> str:
    inner, optional = _optional(hint)
    if typing.get_origin(inner) is tuple:
        args = ["..." if arg is Ellipsis else _describe(arg) for arg in typing.get_args(inner)]
        text = f"tuple[{', '.join(args)}]"
    else:
        text = inner.__name__
    return f"{text} or none" if optional else text


def _build(cls: type, values: Mapping[str, Any], prefix: str) -> Any:
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    for key in values:
        if key not in fields:
            raise unknown("setting", prefix + key, [prefix + name for name in fields])
    for name, field in fields.items():
        no_default = field.default is field.default_factory is dataclasses.MISSING
        if no_default and name not in values:
            raise UsageError(f"{prefix}{name}: expected {_describe(hints[name])}, found nothing")
    found = {key: _convert(value, hints[key], prefix + key) for key, value in values.items()}
    try:
        return cls(**found)
    except SettingError as error:
        # A group of settings does not know what it is a part of; several have a `batch_size`.
        raise SettingError(prefix + error.field, error.complaint) from error


def _convert(value: Any, hint: Any, key: str) -> Any:
    """Returns the JSON value as the annotated type, or raises the UsageError for the field."""
    inner, optional = _optional(hint)
    if value is None and optional:
        return None
    if dataclasses.is_dataclass(inner) and isinstance(value, Mapping):
        return _build(inner, value, f"{key}.")
    if typing.get_origin(inner) is tuple and isinstance(value, (list, tuple)):
        items = _item_hints(inner, len(value))
        if items is not None:
            pairs = enumerate(zip(value, items, strict=True))
            return tuple(_convert(item, item_hint, f"{key}[{i}]") for i, (item, item_hint) in pairs)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if inner is float and is_number:
        return float(value)
    if type(value) is inner:
        return value
    raise UsageError(f"{key}: expected {_describe(hint)}, found {value!r}")


def _parse(text: str, hint: Any, key: str) -> Any:
    """Returns the JSON value that the text stands for in a field of the annotated type."""
    inner, optional = _optional(hint)
    if optional and text.lower() in ("none", "null"):
        return None
    if typing.get_origin(inner) is tuple:
        parts = [part.strip() for part in text.strip("()[]").split(",") if part.strip()]
        items = _item_hints(inner, len(parts))
        if items is not None:
            return [_parse(part, item, key) for part, item in zip(parts, items, strict=True)]
    try:
        if inner is bool:
            return _BOOLS[text.lower()]
        if inner is float:
            return float(text)
        if inner is int:
            return int(text) if text.lstrip("+-").replace("_", "").isdigit() else _whole(text)
        if inner is str:
            return text
    except (KeyError, ValueError, OverflowError):
        pass
    raise UsageError(f"{key}: expected {_describe(hint)}, found {text!r}")


def _whole(text: str) -> int:
    """Reads a whole number in float notation, such as `2e6`."""
    number = float(text)
    if number != int(number):
        raise ValueError(text)
    return int(number)
