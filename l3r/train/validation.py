"""What a validation amounts to, over its graphs and processes."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

from l3r.loss.joint import LossTerms
from l3r.metrics.cameras import CameraMetrics, mean_metrics
from l3r.train.ranks import Agreement


@dataclass(frozen=True, kw_only=True)
class GraphScore:
    """What one validation graph scored."""

    dataset: str
    """Its data set."""
    losses: dict[str, float]
    """Loss, its terms, and the errors behind them."""
    cameras: CameraMetrics
    """Of its cameras by the full inference path."""


class ValidationScores:
    """Collects the scores of a process's graphs; all processes get the means over all graphs.

    Nothing is sent before the means are taken, so processes may have unequal shares, or none.

    Args:
        agreement: With the other processes.
    """

    def __init__(self, agreement: Agreement) -> None:
        self.agreement = agreement
        self._scores: list[GraphScore] = []

    def add(self, dataset: str, terms: LossTerms, cameras: CameraMetrics) -> None:
        """Keep the scores of one graph.

        Args:
            dataset: Its data set.
            terms: The loss of a batch of this graph alone.
            cameras: Metrics of its cameras.
        """
        named = {"loss": terms.total, **terms.parts}
        losses = {name: float(value) for name, value in named.items()}
        self._scores.append(GraphScore(dataset=dataset, losses=losses, cameras=cameras))

    def take(self) -> dict[str, float]:
        """Give the means over all graphs, then those of each data set, and start anew.

        The processes have taken turns at the graphs and take turns here, so sums are made in one
        order and do not depend on the number of processes, not even in the last bit. A loss that
        is not finite shows in its means.
        """
        own, self._scores = self._scores, []
        turns = zip_longest(*self.agreement.gather(own))
        scores = [score for turn in turns for score in turn if score is not None]
        means = _mean(scores)
        for dataset in sorted({score.dataset for score in scores}):
            of_dataset = _mean([score for score in scores if score.dataset == dataset])
            means |= {f"{dataset}/{name}": value for name, value in of_dataset.items()}
        return means


def _mean(scores: Sequence[GraphScore]) -> dict[str, float]:
    losses = {
        name: sum(score.losses[name] for score in scores) / len(scores) for name in scores[0].losses
    }
    return losses | mean_metrics([score.cameras for score in scores]).to_dict()
