"""One way to refuse a value: the key, what was found, what was expected."""

from l3r.errors import ConfigError


def require(condition: bool, key: str, found: object, expected: str) -> None:
    """Raise if a value is out of range.

    Args:
        condition: What must hold.
        key: Full dotted name of the field.
        found: Its value.
        expected: What it should have been, in words that follow "expected".

    Raises:
        ConfigError: The condition is false.
    """
    if not condition:
        raise ConfigError(f"{key} is {found}, expected {expected}")
