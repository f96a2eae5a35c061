"""The table of a sweep as Markdown: the paper's numbers, ours beside them."""

from collections import Counter
from collections.abc import Sequence

from l3r.launch.paper_tables import METRICS as PAPER_METRICS
from l3r.launch.paper_tables import PaperTable
from l3r.launch.results import (
    LOWER_IS_BETTER,
    METRICS,
    RowResult,
    Spread,
    SweepResult,
    best_of_paper,
    best_rows,
    digits_of,
    format_score,
)


def render_markdown(result: SweepResult) -> str:
    """Give the tables of a sweep, ready to be read or pasted."""
    lines = [f"# {result.paper.title if result.paper else result.name}"]
    if result.paper:
        lines += [
            "",
            f'Sweep {result.name}. Paper: {result.paper.source}; {result.paper.benchmark}. "ours" '
            'is the same benchmark, "-" until it is measured.',
            "",
            *_table(*_paper_table(result, result.paper)),
        ]
    scored_on = f"{result.scored_on}. " if result.scored_on else ""
    lines += ["", f"Validation: {scored_on}{_spread_words(result)}", ""]
    lines += _table(*_validation_table(result))
    lines += ["", *_table(*cost_table(result))]
    if result.problems:
        lines += ["", *(f"* {problem}" for problem in result.problems)]
    if result.notes:
        lines += ["", *(f"{number}. {note}" for number, note in enumerate(result.notes, 1))]
    return "\n".join(lines) + "\n"


def format_spread(spread: Spread | None, metric: str, num_seeds: int) -> str:
    """Print mean and deviation; the number of seeds where it is not that of all, or one alone."""
    if spread is None:
        return "-"
    text = format_score(spread.mean, metric)
    if spread.deviation is not None:
        text += f" ± {spread.deviation:.{digits_of(metric)}f}"
    return text if spread.count == num_seeds > 1 else f"{text} (n = {spread.count})"


def describe_kinds(row: RowResult) -> str:
    """Say how many seeds a row has scores of, and what became of the others."""
    if not row.kinds:
        return "-"
    total, counts = len(row.kinds), Counter(row.kinds)
    parts = [f"{counts.pop('scored', 0)} of {total}"]
    parts += [
        f"{kind} {counts[kind]} of {total}" for kind in ("diverged", "failed") if counts[kind]
    ]
    missing = sum(counts[kind] for kind in counts if kind not in ("diverged", "failed"))
    return ", ".join([*parts, *([f"{missing} to come"] if missing else [])])


def cost_table(result: SweepResult) -> tuple[list[str], list[list[str]]]:
    """Give headers and cells of what each row costs and how it differs."""
    headers = [_first_header(result), "s a step", "hours", "GPU GiB", "differs from the base in"]
    cells = [
        [
            row.label,
            "-" if row.step_seconds is None else f"{row.step_seconds:.3g}",
            "-" if row.hours is None else f"{row.hours:.3g}",
            "-" if row.gpu_gib is None else f"{row.gpu_gib:.1f}",
            ", ".join(f"`{key}={now}`" for key, (_, now) in row.changes.items()) or "nothing",
        ]
        for row in result.rows
        if row.kinds
    ]
    return headers, cells


def _spread_words(result: SweepResult) -> str:
    seeds = max((len(row.kinds) for row in result.rows), default=0)
    return f"Mean ± sample standard deviation over {seeds} seeds." if seeds > 1 else "One seed."


def _first_header(result: SweepResult) -> str:
    return result.paper.header if result.paper else "row"


def _arrow(metric: str) -> str:
    return "↓" if metric in LOWER_IS_BETTER else "↑"


def _paper_table(result: SweepResult, paper: PaperTable) -> tuple[list[str], list[list[str]]]:
    headers = [_first_header(result)]
    for name, metric in zip(PAPER_METRICS, METRICS, strict=False):
        headers += [f"{name} {_arrow(metric)}", "ours"]
    rows = []
    for row in result.rows:
        cells = [row.label]
        for column, metric in enumerate(list(METRICS)[: len(PAPER_METRICS)]):
            found = paper.rows.get(row.row)
            text = format_score(found[column] if found else None, metric)
            cells += [_bold(text, row.row in best_of_paper(paper, column)), "-"]
        rows.append(cells)
    return headers, rows


def _validation_table(result: SweepResult) -> tuple[list[str], list[list[str]]]:
    headers = [_first_header(result), *(f"{n} {_arrow(m)}" for m, n in METRICS.items()), "runs"]
    rows = []
    for row in result.rows:
        if not row.kinds:
            continue
        cells = [
            _bold(
                format_spread(row.scores.get(metric), metric, len(row.kinds)),
                row.row in best_rows(result, metric),
            )
            for metric in METRICS
        ]
        rows.append([row.label, *cells, describe_kinds(row)])
    return headers, rows


def _bold(text: str, is_best: bool) -> str:
    return f"**{text}**" if is_best else text


def _table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lay out columns one under the other, so that it can be read as it stands."""
    widths = [max(map(len, column)) for column in zip(headers, *rows, strict=True)]
    lines = [headers, ["-" * width for width in widths], *rows]
    return ["| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines]
