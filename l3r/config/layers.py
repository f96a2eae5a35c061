"""Layers of YAML and ``key=value`` become one typed configuration."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import MarkedYAMLError, YAMLError

from l3r.config.run import RunConfig
from l3r.errors import ConfigError

T = TypeVar("T")


def load_config(layers: Sequence[str]) -> RunConfig:
    """Merge layers left to right; the later one wins.

    Args:
        layers: YAML files, and overrides of the form ``section.key=value``.

    Raises:
        ConfigError: A file cannot be read, a key is unknown, a value is out of range or missing.
            The message names the layer, and the nearest known key.
    """
    config = OmegaConf.structured(RunConfig)
    for layer in layers:
        config = _merge_override(config, layer) if "=" in layer else _merge_file(config, layer)
    if missing := sorted(OmegaConf.missing_keys(config)):
        raise ConfigError(f"no value for {', '.join(missing)}; give one as key=value")
    return cast(RunConfig, _to_object(config, "layers"))


def load_other(path: str, schema: type[T]) -> T:
    """Read a YAML file of another kind than a run's, with the same checks and messages.

    Args:
        path: The file.
        schema: Its dataclass.

    Raises:
        ConfigError: See :func:`load_config`.
    """
    return cast(T, _to_object(_merge_file(OmegaConf.structured(schema), path), path))


def override_config(
    config: RunConfig, overrides: Sequence[str], sections: Sequence[str]
) -> RunConfig:
    """Change a few values of a finished configuration, such as a checkpoint's.

    Args:
        config: Where to start; not changed.
        overrides: ``section.key=value``.
        sections: Sections that may be changed.

    Raises:
        ConfigError: An override is of another section, names no key, or is out of range.
    """
    merged = OmegaConf.merge(OmegaConf.structured(RunConfig), to_plain(config))
    for override in overrides:
        if "=" not in override or override.split(".")[0] not in sections:
            raise ConfigError(
                f"override '{override}': expected key=value of {' or '.join(sections)}, such as "
                f"{sections[0]}.KEY=VALUE"
            )
        merged = _merge_override(cast(DictConfig, merged), override)
    return cast(RunConfig, _to_object(cast(DictConfig, merged), "overrides"))


def to_plain(config: RunConfig) -> dict[str, Any]:
    """Turn a configuration into builtins only, so that a checkpoint holding it loads safely."""
    return asdict(config)


def from_plain(plain: Mapping[str, Any], where: str) -> RunConfig:
    """Rebuild a configuration from what :func:`to_plain` gave.

    Args:
        plain: Nested builtins.
        where: The file they come from, for the message.

    Raises:
        ConfigError: A key is unknown or a value out of range.
    """
    # A file of weights may come from anyone: it must not have the environment read into its texts.
    if found := _find_interpolation(plain):
        raise ConfigError(f"{where}: {found!r} in its configuration, expected plain values")
    try:
        config = OmegaConf.merge(OmegaConf.structured(RunConfig), dict(plain))
    except OmegaConfBaseException as error:
        raise ConfigError(f"{where}: {_first_line(error)}") from error
    return cast(RunConfig, _to_object(cast(DictConfig, config), where))


def to_yaml(config: RunConfig) -> str:
    """Print a configuration as YAML, in the order of its declaration."""
    return OmegaConf.to_yaml(OmegaConf.create(to_plain(config)))


def _find_interpolation(value: object) -> str | None:
    """Find a text that OmegaConf would fill in, anywhere in nested builtins."""
    if isinstance(value, str):
        return value[:80] if "${" in value else None
    if isinstance(value, Mapping):
        parts: Sequence[object] = [*value.keys(), *value.values()]
    else:
        parts = value if isinstance(value, list | tuple) else []
    return next((found for part in parts if (found := _find_interpolation(part))), None)


def _merge_file(config: DictConfig, layer: str) -> DictConfig:
    path = Path(layer)
    if not path.is_file():
        is_yaml = path.suffix in (".yaml", ".yml")
        hint = "check the path" if is_yaml else "an override has the form section.key=value"
        raise ConfigError(f"layer {path}: no such file; {hint}")
    try:
        loaded = OmegaConf.load(path)
        if not isinstance(loaded, DictConfig):
            raise ConfigError(f"layer {path}: expected sections such as 'model:', found a list")
        return cast(DictConfig, OmegaConf.merge(config, loaded))
    except (OmegaConfBaseException, YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"layer {path}: {_first_line(error)}") from error


def _merge_override(config: DictConfig, override: str) -> DictConfig:
    try:
        # A merge, not merge_with_dotlist: only this can add a data source that no file named.
        return cast(DictConfig, OmegaConf.merge(config, OmegaConf.from_dotlist([override])))
    except (OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"override '{override}': {_first_line(error)}") from error


def _to_object(config: DictConfig, where: str) -> object:
    try:
        return OmegaConf.to_object(config)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    except OmegaConfBaseException as error:
        raise ConfigError(f"{where}: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    """Keep what a user needs of a library's many-line message."""
    if isinstance(error, MarkedYAMLError) and error.problem_mark:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return " ".join(str(error).split(" full_key:")[0].split("\n")[0].split())
