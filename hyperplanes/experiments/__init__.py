"""The tables and figures of the HyperPlanes paper, described as data and run by one engine."""

from hyperplanes.experiments.paper.scales import SCALES
from hyperplanes.experiments.paper.tables import EXPERIMENTS, find_experiment, find_experiments

__all__ = ["EXPERIMENTS", "SCALES", "find_experiment", "find_experiments"]
