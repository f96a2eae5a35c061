"""What is wrong with a raw data set: counted under a name, the rest is kept."""

import logging
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

_LOG = logging.getLogger(__name__)

LOGGED_EACH = 10
"""Lines printed for each kind of problem; later ones are only counted."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that was left out."""

    kind: str
    """Name it is counted under: lower-case words joined by underscores, such as ``bad_crc``."""
    where: str
    """File, and record or frame within it."""
    detail: str
    """What was found and what was expected."""


@dataclass(kw_only=True)
class Problems:
    """Collects what a converter could not use.

    A converter reports here and goes on with the next frame or scene; it raises DataError only
    where nothing at all can be read.
    """

    counts: Counter[str] = field(default_factory=Counter)
    """How often each kind was met."""
    first: dict[str, Problem] = field(default_factory=dict)
    """The first of each kind."""
    by_scene: defaultdict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """The same counts for each scene that a converter was reading; what is no scene's is absent."""
    quiet: bool = False
    """Count only: whoever lists the counts says where."""

    def __post_init__(self) -> None:
        """Begin with no scene."""
        self._scene = ""

    @contextmanager
    def about(self, scene: str) -> Iterator[None]:
        """Count what comes up inside the block as a scene's own.

        Args:
            scene: Its name.
        """
        self._scene = scene
        try:
            yield
        finally:
            self._scene = ""

    def add(self, kind: str, where: Path | str, detail: str) -> None:
        """Count a problem; the first few of each kind are logged with their file."""
        self.counts[kind] += 1
        if self._scene:
            self.by_scene[self._scene][kind] += 1
        self.first.setdefault(kind, Problem(kind=kind, where=str(where), detail=detail))
        if self.quiet:
            return
        if self.counts[kind] <= LOGGED_EACH:
            _LOG.warning("%s: %s: %s", kind, where, detail)
        if self.counts[kind] == LOGGED_EACH:
            _LOG.warning("%s: further ones are counted, not shown", kind)

    def summary(self) -> str:
        """One line: ``3 bad_crc, 1 nan_pose``, or ``none``."""
        return ", ".join(f"{n} {kind}" for kind, n in sorted(self.counts.items())) or "none"
