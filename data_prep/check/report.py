"""What a check found in a folder of shards, and the verdict on it."""

import math
from dataclasses import dataclass, field, fields
from typing import Any

from data_prep.check.faults import Faults
from data_prep.check.limits import METRIC_DEPTH, Limits
from data_prep.check.survey import Survey

_UNMEASURED = "nothing measured"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One quantity against its limits."""

    quantity: str
    """Its name."""
    measured: float
    """What was found; NaN where it could not be measured, which is a fault as well."""
    at_least: float | None = None
    """Lowest value allowed."""
    at_most: float | None = None
    """Highest value allowed."""
    form: str
    """How the measured value is written: a format of one number; limits get as many digits as they
    have."""
    unit: str = ""
    """What follows a number."""

    @property
    def passed(self) -> bool:
        """Whether it is within its limits; NaN passes no comparison."""
        low = -math.inf if self.at_least is None else self.at_least
        high = math.inf if self.at_most is None else self.at_most
        return low <= self.measured <= high

    @property
    def measured_text(self) -> str:
        """The value as it is shown."""
        if self.measured != self.measured:
            return _UNMEASURED
        return self.form.format(self.measured) + self.unit

    @property
    def allowed_text(self) -> str:
        """The limits as they are shown."""
        low, high = (self._limit_text(limit) for limit in (self.at_least, self.at_most))
        if self.at_least is None:
            return f"{high} or less"
        return f"{low} or more" if self.at_most is None else f"{low} to {high}"

    def _limit_text(self, limit: float | None) -> str:
        if limit is None:
            return ""
        return f"{100 * limit:g}%" if self.form.endswith("%}") else f"{limit:g}{self.unit}"

    def __str__(self) -> str:
        """One line: quantity, what was found, what was expected."""
        return f"{self.quantity} {self.measured_text}, expected {self.allowed_text}"

    def to_plain(self) -> dict[str, Any]:
        """Give builtins only."""
        keep = ("quantity", "measured", "at_least", "at_most")
        return {**{name: _finite(getattr(self, name)) for name in keep}, "passed": self.passed}


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """What was found in one folder of shards."""

    folder: str
    """The folder."""
    dataset: str
    """Name of the data set."""
    num_graphs: int
    """Graphs in the folder."""
    num_shards: int
    """Tars in the folder."""
    num_bytes: int
    """Their size."""
    digests_compared: bool
    """Whether every tar's SHA-256 was compared with the manifest's."""
    num_damaged_tars: int
    """Tars that are missing or not as the manifest says."""
    num_lost: int
    """Graphs in those tars."""
    num_read: int
    """Graphs of the other tars that were read and decoded fully."""
    num_bad: int
    """Those among them that cannot be used."""
    num_measured: int
    """Graphs whose geometry was measured, spread evenly."""
    num_pairs: int
    """Ordered pairs measured."""
    valid_depth: float
    """Share of pixels whose depth is known."""
    rotation_error: float
    """Largest entry of R R^T - I."""
    connected: float
    """Share of the pairs stored as overlapping that are connected; NaN where there are none."""
    connected_all: float
    """Share of all pairs that are connected."""
    round_trip: float
    """Median over connected pairs of the median distance after a round trip [px]."""
    depth_error: float
    """Median over connected pairs of the median relative difference of depth."""
    depth_bias: float
    """The same with its sign in each pair, which noise does not move."""
    color: float
    """Median over connected pairs of the correlation of brightness."""
    covisible_gap: float
    """Median difference of covisible share, measured against stored; only reported."""
    is_metric: bool
    """Whether all graphs are in metres."""
    median_depth: float
    """Median over images of the median known depth."""
    median_step: float
    """Median distance between two cameras of a graph; only reported."""
    problems: dict[str, int] = field(default_factory=dict)
    """What the build left out, by name, as the manifest records it."""
    faults: Faults = field(default_factory=Faults)
    """What is broken."""
    survey: Survey = field(default_factory=Survey)
    """What the graphs read are like."""

    @property
    def bad_share(self) -> float:
        """Share of all graphs that cannot be used.

        Graphs of damaged tars count in full; of the other graphs, the share of those read stands
        for all. Where all are read it is exact.
        """
        rest = self.num_graphs - self.num_lost
        bad = rest * self.num_bad / self.num_read if self.num_read else 0.0
        return (self.num_lost + bad) / self.num_graphs

    def file_verdicts(self, limits: Limits) -> list[Verdict]:
        """Hold the files against their limits: no damaged tar, few bad graphs."""
        return [
            Verdict(
                quantity="damaged tars",
                measured=float(self.num_damaged_tars),
                at_most=0.0,
                form="{:.0f}",
            ),
            Verdict(
                quantity="share of bad graphs",
                measured=self.bad_share,
                at_most=limits.max_bad_share,
                form="{:.2%}",
            ),
        ]

    def geometry_verdicts(self, limits: Limits) -> list[Verdict]:
        """Hold what was measured in the pixels against its limits."""
        found = [
            Verdict(
                quantity="share of overlapping pairs that connect",
                measured=self.connected,
                at_least=limits.min_connected,
                form="{:.2f}",
            ),
            Verdict(
                quantity="depth disagreement",
                measured=self.depth_error,
                at_most=limits.max_depth_error,
                form="{:.4%}",
            ),
            Verdict(
                quantity="depth bias",
                measured=self.depth_bias,
                at_most=limits.max_depth_bias,
                form="{:.4%}",
            ),
            Verdict(
                quantity="round trip error",
                measured=self.round_trip,
                at_most=limits.max_round_trip,
                form="{:.3f}",
                unit=" px",
            ),
            Verdict(
                quantity="brightness correlation",
                measured=self.color,
                at_least=limits.min_color,
                form="{:.2f}",
            ),
            Verdict(
                quantity="share of known depth",
                measured=self.valid_depth,
                at_least=limits.min_valid_depth,
                form="{:.4f}",
            ),
        ]
        return found + self._scale_verdicts()

    def _scale_verdicts(self) -> list[Verdict]:
        """Metres can be told from millimetres; a scene without a unit can have any scale."""
        if not self.is_metric:
            return []
        low, high = METRIC_DEPTH
        return [
            Verdict(
                quantity="median depth",
                measured=self.median_depth,
                at_least=low,
                at_most=high,
                form="{:.3g}",
                unit=" m",
            )
        ]

    def verdicts(self, limits: Limits) -> list[Verdict]:
        """Hold everything against its limits; geometry only where a graph could be measured."""
        geometry = self.geometry_verdicts(limits) if self.num_measured else []
        return self.file_verdicts(limits) + geometry

    def find_faults(self, limits: Limits) -> list[str]:
        """Say what is out of range: quantity, what was found, what was expected.

        Args:
            limits: What to hold the quantities against.
        """
        return [str(verdict) for verdict in self.verdicts(limits) if not verdict.passed]

    def to_plain(self, limits: Limits) -> dict[str, Any]:
        """Give builtins only; NaN becomes None, since JSON has no NaN."""
        verdicts = self.verdicts(limits)
        nested = ("faults", "survey")
        flat = {f.name: _finite(getattr(self, f.name)) for f in fields(self)}
        return {
            **{name: value for name, value in flat.items() if name not in nested},
            "bad_share": self.bad_share,
            "passed": all(verdict.passed for verdict in verdicts),
            "verdicts": [verdict.to_plain() for verdict in verdicts],
            "faults": self.faults.to_plain(),
            **self.survey.to_plain(),
        }


def _finite(value: Any) -> Any:
    return None if value != value else value
