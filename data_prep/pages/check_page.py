"""The page that ``l3r-prep check`` writes: verdict, faults, histograms, contact sheets."""

from dataclasses import dataclass, field
from typing import Any

from data_prep.check import LIMITS, NOISY, CheckReport, Limits
from data_prep.check.faults import KINDS, LISTED_EACH
from data_prep.pages.charts import Chart, draw_counts, draw_histogram
from data_prep.pages.render import render
from data_prep.pages.sheets import Sheet

NUM_SHEETS = 8
"""Graphs shown on one page; a page of several folders shares them, but shows two of each."""
_MAX_SIZES = 7


@dataclass(kw_only=True)
class Section:
    """One folder of shards on the page."""

    report: CheckReport
    limits: Limits
    """What the report is held against."""
    sheets: list[Sheet] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether everything is within its limits."""
        return all(verdict.passed for verdict in self.report.verdicts(self.limits))


def limits_of(dataset: str) -> Limits:
    """Give the limits of a data set."""
    return LIMITS.get(dataset, NOISY)


def render_check(sections: list[Section]) -> str:
    """Give the page as HTML."""
    return render(
        "check.html",
        passed=all(section.passed for section in sections),
        listed_each=LISTED_EACH,
        sections=[_fill(section) for section in sections],
    )


def _fill(section: Section) -> dict[str, Any]:
    survey = section.report.survey
    sizes = [
        (f"{width} x {height}", count)
        for (height, width), count in survey.image_sizes.most_common()
    ]
    return {
        "report": section.report,
        "verdicts": section.report.verdicts(section.limits),
        "kinds": KINDS,
        "charts": _charts(section.report),
        "sizes": sizes[:_MAX_SIZES],
        "more_sizes": max(0, len(sizes) - _MAX_SIZES),
        "sheets": section.sheets,
    }


def _charts(report: CheckReport) -> list[Chart]:
    survey = report.survey
    if not survey.graph_sizes:
        return []
    return [
        *(draw_histogram(histogram) for histogram in survey.histograms.values()),
        draw_counts(survey.graph_sizes, "Images of a graph", "graphs"),
        draw_counts(survey.num_uses, "Graphs that hold an image", "images"),
    ]
