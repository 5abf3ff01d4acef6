"""The tables and figures of the HyperPlanes paper, each as data and all run by one engine."""

from hyperplanes.experiments.scales import SCALES
from hyperplanes.experiments.tables import EXPERIMENTS

__all__ = ["EXPERIMENTS", "SCALES"]
