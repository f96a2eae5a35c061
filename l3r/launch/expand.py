"""From a sweep file to its runs, and what makes their comparison fair."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from l3r.config import RunConfig, find_changes, flatten_plain, load_config, override_config
from l3r.config.check import require
from l3r.errors import ConfigError
from l3r.launch.sweep_config import SweepConfig, load_sweep

SET_BY_SWEEP = ("train.seed", "train.output_dir")
"""Keys that say which run of the sweep it is."""
_SCORED_ALIKE = "data.validation."
"""Keys that say on what all rows are scored."""
Changes = dict[str, dict[str, tuple[Any, Any]]]
"""(base's value, row's value) by key, of each row."""
_SCORED_SECTIONS = ("graph", "inference", "data")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training, or one checkpoint to be scored, of a sweep."""

    row: str
    seed: int
    folder: Path
    """Where its files go."""
    layers: tuple[str, ...]
    """What ``l3r train`` takes; of a run that is only scored, changes to its configuration."""
    checkpoint: Path
    """What is scored: made by the training, or there before."""
    config: RunConfig | None
    """Of the training; None where a checkpoint is only scored."""

    @property
    def name(self) -> str:
        """``ROW/seed_S``."""
        return f"{self.row}/seed_{self.seed}"


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """All runs of a sweep."""

    file: Path
    """The sweep file."""
    extra: tuple[str, ...]
    """Layers of the command line, on top of the base."""
    out: Path
    """Folder of all runs, and of the tables."""
    spec: SweepConfig
    """The sweep file's content."""
    num_views: int | None
    """Images of each graph that is scored; None: as many as the checkpoint was trained with."""
    changes: Changes
    runs: tuple[Run, ...]
    """The first seed of all rows, then the second, so that a sweep under way can be read."""

    def find(self, name: str) -> Run:
        """Give the run of a name.

        Raises:
            ConfigError: There is none.
        """
        for run in self.runs:
            if run.name == name:
                return run
        known = ", ".join(run.name for run in self.runs)
        raise ConfigError(f"{self.file}: no run '{name}'; expected one of {known}")

    def share(self, task: int, tasks: int) -> tuple[Run, ...]:
        """Give the runs of one of several tasks: ``task``, ``task + tasks``, ...

        Raises:
            ConfigError: There is no such task.
        """
        require(tasks >= 1, "--tasks", tasks, "1 or more")
        require(0 <= task < tasks, "--task-index", task, f"0 to {tasks - 1} of --tasks {tasks}")
        return self.runs[task::tasks]


def expand(file: Path, extra: Sequence[str] = (), out: Path | None = None) -> Sweep:
    """Make the runs of a sweep, and check that they can be compared.

    Args:
        file: The sweep file.
        extra: Layers on top of the base, under the rows: shard folders most often.
        out: Instead of the file's ``output_dir``.

    Raises:
        ConfigError: The file or a layer cannot be used, two rows are the same run, a row sets what
            the sweep sets or what it is scored on, rows differ in the number of images, or there is
            nothing to score on.
    """
    spec = load_sweep(file)
    folder = out or Path(spec.output_dir)
    if forbidden := [x for x in extra if x.partition("=")[0] in SET_BY_SWEEP]:
        raise ConfigError(
            f"'{forbidden[0]}': the sweep sets it; use seeds of {file}, and --out for the folder"
        )
    if spec.checkpoint:
        changes, runs = _scored_runs(spec, tuple(extra), folder)
        num_views = spec.evaluate.num_views
    else:
        base = load_config([*spec.base, *extra])
        if not (spec.evaluate.shards or base.data.validation):
            raise ConfigError(
                f"{file}: nothing to score on; add data.validation.NAME.shards=FOLDER to the base "
                "or to the command line, or evaluate.shards to the file"
            )
        changes, runs = _trained_runs(spec, tuple(extra), folder, base)
        num_views = spec.evaluate.num_views or base.data.num_views
    _refuse_same_rows(file, changes)
    if spec.equal_images:
        require_equal_images(file, {run.row: run.config for run in runs if run.config})
    return Sweep(
        file=file,
        extra=tuple(extra),
        out=folder,
        spec=spec,
        num_views=num_views,
        changes=changes,
        runs=tuple(runs),
    )


def _trained_runs(
    spec: SweepConfig, extra: tuple[str, ...], folder: Path, base: RunConfig
) -> tuple[Changes, list[Run]]:
    configs = {row: load_config([*spec.base, *extra, *added]) for row, added in spec.rows.items()}
    changes = {row: find_changes(base, config) for row, config in configs.items()}
    for row, changed in changes.items():
        if found := [key for key in SET_BY_SWEEP if key in changed]:
            raise ConfigError(f"rows.{row} sets {found[0]}, which the sweep sets; leave it out")
        if found := [key for key in changed if key.startswith(_SCORED_ALIKE)]:
            raise ConfigError(
                f"rows.{row} sets {found[0]}, but all rows are scored alike; put it into the base"
            )
    runs = []
    for seed in spec.seeds:
        for row, config in configs.items():
            own = folder / row / f"seed_{seed}"
            place = (f"train.seed={seed}", f"train.output_dir={own}")
            runs.append(
                Run(
                    row=row,
                    seed=seed,
                    folder=own,
                    layers=(*spec.base, *extra, *spec.rows[row], *place),
                    checkpoint=own / "model.ckpt",
                    config=replace(
                        config, train=replace(config.train, seed=seed, output_dir=str(own))
                    ),
                )
            )
    return changes, runs


def _scored_runs(
    spec: SweepConfig, extra: tuple[str, ...], folder: Path
) -> tuple[Changes, list[Run]]:
    common = _as_settings([*spec.base, *extra])
    # On the defaults: the checkpoints need not be there yet.
    base = override_config(RunConfig(), common, _SCORED_SECTIONS)
    settings = {row: _as_settings(added) for row, added in spec.rows.items()}
    changes = {
        row: find_changes(base, override_config(base, own, _SCORED_SECTIONS))
        for row, own in settings.items()
    }
    runs = [
        Run(
            row=row,
            seed=seed,
            folder=folder / row / f"seed_{seed}",
            layers=(*common, *settings[row]),
            checkpoint=Path(spec.checkpoint.replace("{seed}", str(seed))),
            config=None,
        )
        for seed in spec.seeds
        for row in spec.rows
    ]
    return changes, runs


def _as_settings(layers: Sequence[str]) -> list[str]:
    """Turn layers into ``key=value`` alone, which a checkpoint's configuration can be given."""
    settings = []
    for layer in layers:
        if "=" in layer:
            settings.append(layer)
            continue
        try:
            content = OmegaConf.to_container(OmegaConf.load(layer), resolve=True)
        except (OSError, OmegaConfBaseException, YAMLError) as error:
            raise ConfigError(f"layer {layer}: {str(error).splitlines()[0]}") from error
        flat = flatten_plain(cast(dict[str, Any], content) if isinstance(content, dict) else {})
        settings += [f"{key}={value}" for key, value in flat.items()]
    return settings


def _refuse_same_rows(file: Path, changes: Changes) -> None:
    seen: dict[str, str] = {}
    for row, changed in changes.items():
        twin = seen.setdefault(repr(changed), row)
        if twin != row:
            raise ConfigError(
                f"{file}: rows '{twin}' and '{row}' are the same run; leave one out, or let them "
                "differ from the base in other ways"
            )


def require_equal_images(file: Path, configs: dict[str, RunConfig]) -> None:
    """Refuse rows that see more or fewer images than others.

    They must have as many steps, and images a step that a single number, rounded to whole graphs,
    would give.

    Args:
        file: The sweep file, for the message.
        configs: By row.

    Raises:
        ConfigError: They do not.
    """
    steps = {row: config.train.max_steps for row, config in configs.items()}
    if len(set(steps.values())) > 1:
        found = ", ".join(f"{row}: {number:,}" for row, number in steps.items())
        raise ConfigError(
            f"{file}: train.max_steps differs between rows ({found}), expected as many; leave it "
            "to the base, or set equal_images: false to compare them all the same"
        )
    data = {row: config.data for row, config in configs.items()}
    lowest = max(((d.graphs_per_step - 0.5) * d.num_views for d in data.values()), default=0)
    highest = min(((d.graphs_per_step + 0.5) * d.num_views for d in data.values()), default=0)
    if lowest > highest:
        found = ", ".join(f"{row}: {d.graphs_per_step * d.num_views}" for row, d in data.items())
        raise ConfigError(
            f"{file}: images a step differ between rows ({found}), expected as many but for "
            "rounding to whole graphs; set data.graphs_per_step with data.num_views, or "
            "equal_images: false to compare them all the same"
        )
