"""What two configurations differ in."""

from collections.abc import Mapping
from typing import Any

from l3r.config.layers import to_plain
from l3r.config.run import RunConfig


def flatten_plain(plain: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Turn nested sections into one mapping by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in plain.items():
        if isinstance(value, Mapping):
            flat |= flatten_plain(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def find_changes(before: RunConfig, now: RunConfig) -> dict[str, tuple[Any, Any]]:
    """List what changed.

    Returns:
        (value before, value now) by dotted key, sorted; None where a configuration lacks the key.
    """
    old, new = flatten_plain(to_plain(before)), flatten_plain(to_plain(now))
    return {
        key: (old.get(key), new.get(key))
        for key in sorted(old.keys() | new.keys())
        if old.get(key) != new.get(key)
    }
