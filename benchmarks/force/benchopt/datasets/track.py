"""The published tracks."""

from benchopt import BaseDataset

from benchmarks.force.problems import load, names


class Dataset(BaseDataset):
    """The sessions of a track."""

    name = "track"
    parameters = {"track": names()}  # noqa: RUF012
    test_parameters = {"track": ["soft"]}  # noqa: RUF012

    def get_data(self):  # noqa: D102
        return {"sessions": load(self.track).sessions}
