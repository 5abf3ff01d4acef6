"""The tables and figures of the HyperPlanes paper, each as data and all run by one engine."""

from hyperplanes.reproduce.experiments import EXPERIMENTS
from hyperplanes.reproduce.scales import SCALES

__all__ = ["EXPERIMENTS", "SCALES"]
