"""Errors a user can act on.

Every message is one line that says where (file, key, shard, sample), what was found, what was
expected and what to do. The command line prints it and exits with code 2.
"""


class L3RError(Exception):
    """Any failure whose cause lies outside the code."""


class ConfigError(L3RError, ValueError):
    """A configuration layer or override that cannot be used."""


class DataError(L3RError):
    """A file, shard or sample that cannot be used."""


class GeometryError(L3RError):
    """Points or cameras that admit no solution."""


class NotFiniteError(GeometryError):
    """Numbers of a network that are not finite: its weights are broken, or training diverged."""


class CheckpointError(L3RError):
    """A checkpoint that cannot be read or does not fit."""


class LaunchError(L3RError):
    """A training run that cannot start or go on."""
