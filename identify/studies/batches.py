"""Rows in batches: as many a task as keep a worker busy for a while, so that sending them costs little."""

from collections.abc import Iterator
from itertools import islice

from identify.studies.computation import Finished
from identify.studies.design import Case

BATCH_SECONDS = 0.25
"""Work in a batch; what is lost at most with each worker when everything is killed at once."""

LARGEST_BATCH = 500


class Batches:
    """Hands out the rows that are still to be done, in batches sized by how long the last ones took."""

    def __init__(self, cases: Iterator[Case], count: int) -> None:
        self._cases, self._left = cases, count
        self._row_seconds = BATCH_SECONDS

    def take(self, workers: int) -> list[Case]:
        """The next batch for one of so many workers; empty when all rows are handed out.

        Towards the end batches become smaller, so that all workers end together.
        """
        fair = max(1, self._left // (4 * workers))
        size = max(1, min(int(BATCH_SECONDS / self._row_seconds), LARGEST_BATCH, fair, self._left))
        batch = list(islice(self._cases, size))
        self._left -= len(batch)
        return batch

    def learn(self, finished: list[Finished]) -> None:
        """Take from a finished batch how long rows take."""
        mean = sum(row.seconds for row in finished) / len(finished)
        self._row_seconds = max(0.5 * (self._row_seconds + mean), 1e-6)
